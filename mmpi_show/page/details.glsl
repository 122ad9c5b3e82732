// Residuals of the training images near a camera (docs/details.md), as rendering/details.py.
uniform int seen; // training images
uniform float seenStep, infinity; // of codes of differences; inverse distance that stands for infinity
uniform vec4 seenImage[SEEN];  // width, height, layer, factor on weights
uniform vec4 seenEye[SEEN];    // position; inverse distance of code 255
uniform mat3 seenTurn[SEEN];   // camera axes to the world's
uniform vec4 seenLens[SEEN];   // focal lengths and centre, pixels
uniform vec4 seenBend[SEEN];   // k1, k2, k3, k4
uniform vec4 seenRest[SEEN];   // p1, p2, whether a fisheye, largest distance from the centre
uniform sampler2DArray differences, depths;

// Pixel of a direction in the axes of a training image; false if it lies outside.
bool project(int i, vec3 local, out vec2 at) {
  vec4 rest = seenRest[i], k = seenBend[i];
  float ahead = -local.z, radius = length(local.xy);
  if (rest.z <= 0.0 && ahead <= TINY) return false;
  float scale = rest.z > 0.0 ? atan(radius, ahead) / max(radius, TINY) : 1.0 / ahead;
  if (!(radius * scale <= rest.w)) return false;
  vec2 p = vec2(local.x, -local.y) * scale;
  float r = dot(p, p);
  vec2 bent = p * (1.0 + r * (k.x + r * (k.y + r * (k.z + r * k.w)))) + 2.0 * rest.xy * p.x * p.y + rest.yx * (r + 2.0 * p * p);
  at = seenLens[i].xy * bent + seenLens[i].zw;
  return all(greaterThan(at, vec2(0.0))) && all(lessThan(at, seenImage[i].xy));
}

// Codes at a place in [0, 1] of an image that takes a corner of a layer.
vec3 codesAt(sampler2DArray images, vec2 place, vec2 size, float layer) {
  vec2 at = clamp(place * size, vec2(0.5), size - 0.5) / vec2(textureSize(images, 0).xy);
  return 255.0 * textureLod(images, vec3(at, layer), 0.0).rgb;
}

// The detail added to the radiance of a ray whose surface is at this inverse distance.
vec3 details(vec3 direction, float inverse, vec3 radiance) {
  vec3 total = vec3(0.0);
  float weight = LEAST_WEIGHT;
  for (int i = 0; i < SEEN; i++) {
    if (i >= seen) break;
    vec3 towards = eye - seenEye[i].xyz, relative = inverse * towards + direction;
    float far = max(length(relative), TINY);
    vec4 image = seenImage[i];
    vec2 at;
    if (!project(i, relative * seenTurn[i], at)) continue;
    float code = codesAt(depths, at / image.xy, ceil(image.xy / float(COARSE)), image.z).r;
    if (code < 0.5) continue;
    float root = max(code - 1.0, 0.0) / 254.0, angle = length(relative / far - direction);
    float w = image.w * agreement(seenEye[i].w * root * root, inverse / far, seenLens[i].x * length(towards), angle, far);
    vec3 difference = seenStep * (codesAt(differences, at / image.xy, image.xy, image.z) - 128.0);
    total += w * faded(angle) * (difference - HERE * (radiance - MIDDLE));
    weight += w;
  }
  return STRENGTH * total / weight;
}

// A colour with details; a ray that ends in the background is marched again for its depth.
vec3 detailed(vec3 color, vec3 direction, float surface) {
  if (seen == 0 || mass <= 0.0) return color;
  float opacity = 1.0 - transmittance;
  if (opacity < 0.9) surface = march(direction, mass);
  return clamp(color + exposure * opacity * details(direction, max(surface, infinity), color / exposure), 0.0, 1.0);
}
