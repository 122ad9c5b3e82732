// One window of a baked scene: every ray intersects the bricks of all MPIs in order of distance, sums codes until it is
// opaque, and is shaded once. What stands between "each" and "end" is repeated for every MPI, with its number for K_.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
precision highp sampler2DArray;

ENDS

const int MOST = 4096; // samples of a ray

uniform vec3 eye;
uniform mat3 turn;     // camera axes (right, up, back) to the world's
uniform vec4 lens;     // focal lengths and centre, pixels
uniform float rows;    // of the image
uniform int mode;      // 0 colour, 1 depth, 2 winning MPI
uniform int alone;     // this MPI alone; -1 for all
uniform float share;   // of the window
uniform float rayNear, threshold, background;
uniform vec3 exposure;
uniform vec2 depthRange; // logarithms of the distances at the ends of the ramp
uniform vec2 densityCodes; // low, step
uniform vec4 low[GROUPS], step_[GROUPS]; // of the channels; features' doubled, for tanh x = 2 sigmoid(2 x) - 1
uniform usampler2D columns;
uniform sampler2D density;
uniform sampler2D texels[GROUPS];

// Of each MPI:
uniform vec3 origin[HEADS];
uniform mat3 axes[HEADS];    // columns: x, y, z axis
uniform vec4 extent[HEADS];  // u0, u1, v0, v1
uniform vec4 planes[HEADS];  // disparity between planes, of the last one, factor on softplus, number of planes
uniform ivec4 sizes[HEADS];  // height, width, tiles down, tiles across
uniform int first[HEADS];    // column

out vec4 pixel;

int count(uint v) {
  v -= (v >> 1) & 0x55555555u;
  v = (v & 0x33333333u) + ((v >> 2) & 0x33333333u);
  return int((((v + (v >> 4)) & 0x0F0F0F0Fu) * 0x01010101u) >> 24);
}

int lowest(uint v) { return (floatBitsToInt(float(v & (~v + 1u))) >> 23) - 127; }

// Plane at which a ray has left a tile along one axis.
float leaves(float start, float slope, int tile) {
  if (slope == 0.0) return 1e9;
  return (float(slope > 0.0 ? tile * 7 + 7 : tile * 7) - start) / slope;
}

/*each*/
// A ray on its way through MPI K_: texel on plane l = start + l * slope.
vec2 startK_, slopeK_, facingK_;
ivec2 tileK_;
int leftK_, lastK_, planeK_, brickK_, wordK_;
uint aheadK_;
float nextK_ = -1.0; // inverse distance of the next sample; -1: none

void advanceK_() {
  while (aheadK_ == 0u) {
    int l = leftK_ + 1;
    if (l > lastK_) { nextK_ = -1.0; return; }
    vec2 at = startK_ + float(l) * slopeK_;
    tileK_ = clamp(ivec2(at / 7.0), ivec2(0), sizes[K_].wz - 1);
    wordK_ = l / 32;
    int index = first[K_] + (wordK_ * sizes[K_].z + tileK_.y) * sizes[K_].w + tileK_.x;
    uvec2 column = texelFetch(columns, ivec2(index % COLUMNS, index / COLUMNS), 0).xy;
    float leaving = min(leaves(startK_.x, slopeK_.x, tileK_.x), leaves(startK_.y, slopeK_.y, tileK_.y));
    leftK_ = min(lastK_, wordK_ * 32 + 31);
    if (leaving < float(leftK_)) leftK_ = max(l, int(leaving));
    uint from = 0xFFFFFFFFu << uint(l & 31);
    aheadK_ = column.x & from & (0xFFFFFFFFu >> uint(31 - (leftK_ & 31)));
    brickK_ = int(column.y) + count(column.x & ~from) - 1;
  }
  planeK_ = wordK_ * 32 + lowest(aheadK_);
  aheadK_ &= aheadK_ - 1u;
  brickK_++;
  float w = (planes[K_].w - 1.0 - float(planeK_)) * planes[K_].x + planes[K_].y;
  nextK_ = w * facingK_.y / (1.0 - w * facingK_.x);
}

void beginK_(vec3 direction) {
  vec3 o = (eye - origin[K_]) * axes[K_], d = direction * axes[K_];
  nextK_ = -1.0;
  if (!(d.z > FACING) || (alone >= 0 && alone != K_)) return;
  vec2 uv = d.xy / d.z, bend = o.xy - o.z * uv;
  // Half-spaces p w <= q in disparity.
  vec4 p = vec4(bend.x, -bend.x, bend.y, -bend.y);
  vec4 q = vec4(extent[K_].y - uv.x, uv.x - extent[K_].x, extent[K_].w - uv.y, uv.y - extent[K_].z);
  float lo = 0.0, hi = planes[K_].w - 1.0, near = d.z * rayNear + o.z;
  if (near > 0.0) hi = min(hi, (1.0 / near - planes[K_].y) / planes[K_].x);
  for (int i = 0; i < 4; i++) {
    float slope = p[i] * planes[K_].x, rest = q[i] - p[i] * planes[K_].y;
    if (slope > 0.0) hi = min(hi, rest / slope);
    else if (slope < 0.0) lo = max(lo, rest / slope);
    else if (rest < 0.0) return;
  }
  if (!(lo <= hi)) return;
  leftK_ = int(planes[K_].w) - 2 - int(floor(hi));
  lastK_ = int(planes[K_].w) - 1 - int(ceil(lo));
  vec2 scale = vec2(sizes[K_].yx - 1) / (extent[K_].yw - extent[K_].xz);
  slopeK_ = -bend * planes[K_].x * scale;
  startK_ = (uv + bend * planes[K_].y - extent[K_].xz) * scale - (planes[K_].w - 1.0) * slopeK_;
  facingK_ = vec2(o.z, d.z);
  aheadK_ = 0u;
  advanceK_();
}
/*end*/

NETWORK

vec3 ramp(float x) { // dark blue, red, yellow
  x = clamp(x, 0.0, 1.0);
  return x < 0.5 ? mix(vec3(0.05, 0.03, 0.3), vec3(0.8, 0.25, 0.3), 2.0 * x)
                 : mix(vec3(0.8, 0.25, 0.3), vec3(0.98, 0.95, 0.55), 2.0 * x - 1.0);
}

vec3 tint(int k) { return 0.55 + 0.45 * cos(6.2832 * (float(k) * 0.381966 + vec3(0.0, 0.33, 0.67))); }

vec4 sums[GROUPS];
float transmittance, mass, votes[HEADS];

// Marches a ray. Returns the inverse distance at which it has gathered half of the expected mass; -1 where it never does.
float march(vec3 direction, float expected) {
  for (int g = 0; g < GROUPS; g++) sums[g] = vec4(0.0);
  float depth = -1.0;
  transmittance = 1.0, mass = 0.0;
  /*each*/ beginK_(direction); votes[K_] = 0.0;
  /*end*/
  vec2 size = vec2(textureSize(density, 0));
  int per = int(size.x) / 8;
  for (int i = 0; i < MOST; i++) {
    float inverse = -1.0;
    int h = -1, brick = 0;
    vec2 place = vec2(0.0);
    /*each*/ if (nextK_ > inverse) { inverse = nextK_; h = K_; }
    /*end*/
    if (h < 0) break;
    float interval = 0.0;
    /*each*/ if (h == K_) {
      brick = brickK_;
      place = clamp(startK_ + float(planeK_) * slopeK_ - float(7) * vec2(tileK_), 0.0, 7.0);
      interval = planes[K_].z;
    }
    /*end*/
    vec2 uv = (vec2(ivec2(brick % per, brick / per) * 8) + 0.5 + place) / size;
    float raw = densityCodes.x + densityCodes.y * 255.0 * textureLod(density, uv, 0.0).r;
    float pass = exp(-interval * (max(raw, 0.0) + log(1.0 + exp(-abs(raw)))));
    float weight = transmittance * (1.0 - pass);
    if (weight > threshold) {
      GATHER
      mass += weight;
      if (depth < 0.0 && is_depth(mass, expected)) depth = inverse;
      /*each*/ if (h == K_) votes[K_] += weight;
      /*end*/
    }
    transmittance *= pass;
    if (is_terminated(transmittance, OPAQUE_BAKED)) { transmittance = 0.0; break; }
    /*each*/ if (h == K_) advanceK_();
    /*end*/
  }
  return depth;
}

DETAILS

void main() {
  vec2 at = vec2(gl_FragCoord.x, rows - gl_FragCoord.y);
  vec3 direction = normalize(turn * vec3((at.x - lens.z) / lens.x, -(at.y - lens.w) / lens.y, -1.0));
  float surface = march(direction, 1.0);
  vec3 color = vec3(0.0);
  if (mode == 1) { // half of what a ray gathers is known once it has gathered it
    float depth = mass > 0.0 ? march(direction, mass) : -1.0;
    color = ramp((log(1.0 / max(depth, 1e-6)) - depthRange.x) / (depthRange.y - depthRange.x));
  } else if (mode == 2) {
    float most = 0.0;
    /*each*/ if (votes[K_] > most) { most = votes[K_]; color = tint(K_); }
    /*end*/
  } else {
    if (mass > 0.0) color = exposure * shade(sums, mass, direction) * (1.0 - transmittance);
    color = clamp(color + transmittance * background, 0.0, 1.0);
    ADD_DETAILS
  }
  pixel = vec4(share * color, share);
}
