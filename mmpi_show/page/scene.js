// Reading a baked scene and drawing it with WebGL2. The format is in docs/export.md.
"use strict";

class Refusal extends Error {} // an error whose message is a sentence for the reader

const WORD_WIDTH = 2048;

// An array of a window, from bytes that begin at `from` in its file.
async function unpack(bytes, spec, from = 0) {
  const part = bytes.subarray(spec.offset - from, spec.offset - from + spec.bytes);
  try {
    const stream = new Blob([part]).stream().pipeThrough(new DecompressionStream("gzip"));
    const data = await new Response(stream).arrayBuffer(), type = { uint8: Uint8Array, uint32: Uint32Array, float16: Uint16Array }[spec.type];
    return new type(data, 0, spec.shape.reduce((a, b) => a * b, 1));
  } catch (error) {
    throw new Refusal(`A file of this scene is damaged (${error.message}): copy it anew, or export the scene again.`);
  }
}

const ones = (v) => { let n = 0; for (; v; v &= v - 1) n++; return n; };

// Columns as the shader reads them: bits of the planes, and the number of the first brick.
function numberedColumns(masks) {
  const columns = new Uint32Array(2 * masks.length);
  let bricks = 0;
  masks.forEach((mask, c) => { columns[2 * c] = mask; columns[2 * c + 1] = bricks; bricks += ones(mask); });
  return columns;
}

// Numbers of the bricks of `early`, and of the others, among all of `masks`.
function earlyAndLate(masks, early) {
  const numbers = [[], []];
  let brick = 0;
  masks.forEach((mask, c) => {
    for (let bit = 0; bit < 32; bit++) if (mask >>> bit & 1) numbers[early[c] >>> bit & 1 ? 0 : 1].push(brick++);
  });
  return numbers;
}

// For each brick the ones right of it and below it in its plane, as they are in `columns`; -1 for none.
function neighbours(mpis, columns, bricks) {
  const right = new Int32Array(bricks).fill(-1), below = new Int32Array(bricks).fill(-1);
  const number = (column, bit) =>
    columns[2 * column] >>> bit & 1 ? columns[2 * column + 1] + ones(columns[2 * column] & ~(-1 << bit)) : -1;
  for (const m of mpis) {
    const across = Math.ceil((m.width - 1) / 7), down = Math.ceil((m.height - 1) / 7), words = Math.ceil(m.planes / 32);
    for (let c = 0; c < words * down * across; c++) {
      if (!columns[2 * (m.first_column + c)]) continue;
      for (let bit = 0; bit < 32; bit++) {
        const column = m.first_column + c, brick = number(column, bit);
        if (brick < 0) continue;
        if (c % across + 1 < across) right[brick] = number(column + 1, bit);
        if (Math.floor(c / across) % down + 1 < down) below[brick] = number(column + across, bit);
      }
    }
  }
  return { right, below };
}

// Codes of every second row and column of all channels from their differences, both [channels, 16, bricks], in place.
function sumDifferences(all, channels) {
  const each = all.length / channels, bricks = each / 16;
  for (let c = 0; c < channels; c++) {
    const stored = all.subarray(c * each, (c + 1) * each);
    for (let b = 1; b < bricks; b++) stored[b] += stored[b - 1];
    for (let p = 1; p < 16; p++)
      if (p % 4) for (let b = 0; b < bricks; b++) stored[p * bricks + b] += stored[(p - 1) * bricks + b];
    for (let at = 4 * bricks; at < each; at++) stored[at] += stored[at - 4 * bricks];
  }
  return all;
}

// Puts such codes into the 8 x 8 of the bricks of these numbers.
function placeCoarse(codes, coarse, numbers) {
  for (let p = 0; p < 16; p++)
    for (let i = 0; i < numbers.length; i++)
      codes[64 * numbers[i] + 16 * (p >> 2) + 2 * (p & 3)] = coarse[p * numbers.length + i];
}

// The other codes: means of those beside them, and the differences from these, [48, bricks], where they are there.
function addFine(codes, fine) {
  const bricks = codes.length / 64;
  const add = (p, from, step, isLast) => {
    const row = fine && fine.subarray(from * bricks, (from + 1) * bricks), after = isLast ? -step : step;
    for (let b = 0, at = p; b < bricks; b++, at += 64) codes[at] = (row ? row[b] : 0) + (codes[at - step] + codes[at + after] >> 1);
  };
  for (let y = 0; y < 8; y += 2) for (let x = 1; x < 8; x += 2) add(8 * y + x, 6 * y + (x >> 1), 1, x === 7);
  for (let y = 1; y < 8; y += 2) for (let x = 0; x < 8; x++) add(8 * y + x, 6 * y - 2 + x, 8, y === 7);
}

// Border texels from the neighbours that hold them too.
function takeBorders(codes, { right, below }) {
  const bricks = codes.length / 64;
  for (let b = 0; b < bricks; b++)
    if (right[b] >= 0) for (let y = 0; y < 7; y++) codes[64 * b + 8 * y + 7] = codes[64 * right[b] + 8 * y];
  for (let b = 0; b < bricks; b++)
    if (below[b] >= 0) for (let x = 0; x < 8; x++) codes[64 * b + 56 + x] = codes[64 * below[b] + x];
  for (let b = 0; b < bricks; b++)
    if (right[b] >= 0 && below[b] < 0) codes[64 * b + 63] = codes[64 * right[b] + 56];
}

function halves(data) {
  return Float32Array.from(data, (bits) => {
    const exponent = (bits >> 10) & 31, fraction = bits & 1023, sign = bits >> 15 ? -1 : 1;
    if (exponent === 0) return sign * fraction * 2 ** -24;
    return exponent === 31 ? sign * Infinity : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  });
}

// The network as GLSL, its numbers in a uniform block; weights of four inputs are one vec4, and biases those of an input of 1.
function networkSource(shader, channels) {
  const encoded = 3 * shader.direction_octaves, lines = [], quads = (n) => Math.ceil((n + 1) / 4);
  let block = 0;
  const begun = (x, size) => `float ${x}[${4 * quads(size)}]; for (int i = 0; i < ${4 * quads(size)}; i++) ${x}[i] = float(i == ${size});`;
  shader.layers.forEach(([outputs, inputs], layer) => {
    const from = `x${layer}`, to = `x${layer + 1}`;
    lines.push(begun(to, outputs));
    lines.push(`for (int o = 0; o < ${outputs}; o++) { float sum = 0.0;`);
    lines.push(`  for (int i = 0; i < ${quads(inputs)}; i++) sum += dot(numbers[${block} + o * ${quads(inputs)} + i],`);
    lines.push(`    vec4(${from}[4 * i], ${from}[4 * i + 1], ${from}[4 * i + 2], ${from}[4 * i + 3]));`);
    lines.push(`  ${to}[o] = ${layer + 1 < shader.layers.length ? "max(sum, 0.0)" : "sum"}; }`);
    block += outputs * quads(inputs);
  });
  const last = `x${shader.layers.length}`;
  return {
    size: block,
    source: `layout(std140) uniform Network { vec4 numbers[${block}]; };
vec3 shade(vec4 sums[GROUPS], float mass, vec3 direction) {
  ${begun("x0", channels + 3 + 2 * encoded)}
  for (int c = 0; c < ${channels}; c++) x0[c] = (c < 3 ? 1.0 : 2.0) * sums[c >> 2][c & 3] / mass - (c < 3 ? 0.0 : 1.0);
  vec3 mean = vec3(x0[0], x0[1], x0[2]);
  for (int a = 0; a < 3; a++) x0[${channels} + a] = direction[a];
  for (int i = 0; i < ${encoded}; i++) {
    float angle = ${Math.PI.toFixed(9)} * float(1 << i / 3) * direction[i % 3];
    x0[${channels + 3} + i] = sin(angle);
    x0[${channels + 3 + encoded} + i] = cos(angle);
  }
  ${lines.join("\n  ")}
  vec3 change = vec3(${last}[0], ${last}[1], ${last}[2]) / ${shader.bound.toFixed(6)};
  return mean / (mean + (1.0 - mean) * exp(-${shader.bound.toFixed(6)} * tanh(clamp(change, -9.0, 9.0))));
}`,
  };
}

// The numbers of the block above, from the file's order: weights [outputs, inputs], then biases, layer by layer.
function networkBlock(shader, numbers, size) {
  const block = new Float32Array(4 * size);
  let from = 0, to = 0;
  for (const [outputs, inputs] of shader.layers) {
    for (let o = 0; o < outputs; o++, to += 4 * Math.ceil((inputs + 1) / 4)) {
      block.set(numbers.subarray(from + o * inputs, from + (o + 1) * inputs), to);
      block[to + inputs] = numbers[from + outputs * inputs + o];
    }
    from += outputs * (inputs + 1);
  }
  return block;
}

// Interpolation of the texture in use, without wrapping.
function setSampling(gl, target, filter) {
  for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(target, gl[`TEXTURE_${name}`], filter);
  for (const name of ["WRAP_S", "WRAP_T"]) gl.texParameteri(target, gl[`TEXTURE_${name}`], gl.CLAMP_TO_EDGE);
}

// One window on the graphics card: first the bricks that are seen most, at half of their resolution, then all of it.
class WindowOnCard {
  // `details` says how many training images a picture takes details from, and binds them.
  static async load(gl, row, bytes, details) {
    const { arrays, channels } = row, limit = gl.getParameter(gl.MAX_TEXTURE_SIZE), per = limit >= 4096 ? 512 : 256;
    const card = Object.assign(new WindowOnCard(), { gl, row, per, details, textures: [], heads: row.mpis.length, whole: false });
    if (Math.ceil(arrays.fine.shape[2] / per) * 8 > limit)
      throw new Refusal("This scene is larger than the textures of this graphics card: export fewer bricks (--least).");
    const network = networkSource(row.shader, channels.length);
    if (network.size * 16 > gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE))
      throw new Refusal("The network of this scene is too wide for this graphics card.");
    card.groups = Math.ceil(channels.length / 4);
    const uniforms = 8 * (card.heads + details.nearest) + 32; // vectors, at most
    card.detailed = details.nearest > 0 && uniforms <= gl.getParameter(gl.MAX_FRAGMENT_UNIFORM_VECTORS);
    card.program = card.compile(network.source);
    card.earlyMasks = await unpack(bytes, arrays.early_columns);
    card.early = sumDifferences(await unpack(bytes, arrays.early), channels.length + 1);
    const numbers = halves(await unpack(bytes, arrays.network));
    card.fill(card.earlyMasks, [[card.early, Array.from({ length: arrays.early.shape[2] }, (_, b) => b)]], null);
    card.setConstants(networkBlock(row.shader, numbers, network.size));
    return card;
  }

  // The rest of the file.
  async complete(bytes) {
    const { arrays, channels, first_bytes } = this.row;
    const masks = await unpack(bytes, arrays.columns, first_bytes);
    const late = sumDifferences(await unpack(bytes, arrays.late, first_bytes), channels.length + 1);
    const fine = await unpack(bytes, arrays.fine, first_bytes), [first, others] = earlyAndLate(masks, this.earlyMasks);
    if (this.freed) return;
    this.fill(masks, [[this.early, first], [late, others]], fine);
    this.early = this.earlyMasks = null;
    this.whole = true;
  }

  // Textures of the bricks of `masks`. `parts`: coarse codes of all channels, and the numbers of their bricks.
  fill(masks, parts, fine) {
    const { gl, row, groups } = this, channels = row.channels.length, bricks = parts.reduce((n, [, numbers]) => n + numbers.length, 0);
    const columns = numberedColumns(masks), beside = neighbours(row.mpis, columns, bricks);
    const codesOf = (channel) => {
      const codes = new Uint8Array(64 * bricks);
      for (const [coarse, numbers] of parts) placeCoarse(codes, coarse.subarray(channel * 16 * numbers.length, (channel + 1) * 16 * numbers.length), numbers);
      addFine(codes, fine && fine.subarray(channel * 48 * bricks, (channel + 1) * 48 * bricks));
      takeBorders(codes, beside);
      return codes;
    };
    this.freeTextures();
    const height = Math.max(1, Math.ceil(masks.length / WORD_WIDTH)), padded = new Uint32Array(2 * WORD_WIDTH * height);
    padded.set(columns);
    this.addTexture(gl.RG32UI, WORD_WIDTH, height, gl.RG_INTEGER, gl.UNSIGNED_INT, padded, gl.NEAREST);
    this.addAtlas([codesOf(0)], bricks, 1);
    for (let g = 0; g < groups; g++) {
      const some = Array.from({ length: Math.min(channels - 4 * g, 4) }, (_, c) => codesOf(1 + 4 * g + c));
      this.addAtlas(some, bricks, 4);
    }
  }

  compile(network) {
    const { gl } = this;
    const gather = Array.from({ length: this.groups }, (_, g) =>
      `sums[${g}] += weight / (1.0 + exp(-(low[${g}] + step_[${g}] * textureLod(texels[${g}], uv, 0.0))));`);
    const fragment = "#version 300 es\n" + MARCH
      .replace("NETWORK", network)
      .replace("ADD_DETAILS", this.detailed ? "color = detailed(color, direction, surface);" : "")
      .replace("DETAILS", this.detailed ? DETAILS : "")
      .replace("GATHER", gather.join("\n"))
      .replace(/\/\*each\*\/([\s\S]*?)\/\*end\*\//g, (_, body) =>
        Array.from({ length: this.heads }, (_, k) => body.replaceAll("K_", k)).join("\n"))
      .replaceAll("GROUPS", this.groups).replaceAll("HEADS", this.heads).replaceAll("COLUMNS", WORD_WIDTH)
      .replaceAll("SEEN", this.details.nearest).replaceAll("COARSE", COARSE);
    const vertex = `#version 300 es
      void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;
    const program = gl.createProgram(), logs = [];
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      logs.push(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Refusal(`The graphics card does not take the page's program (${logs.join("")}${gl.getProgramInfoLog(program)}).`);
    return program;
  }

  addTexture(internal, width, height, format, type, data, filter) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
    setSampling(gl, gl.TEXTURE_2D, filter);
    this.textures.push(texture);
  }

  // Bricks side by side in a texture of 8 x 8 texels each; `channels` lists the code arrays that fill r, g, b, a.
  addAtlas(channels, bricks, count) {
    const { gl, per } = this, width = per * 8, height = 8 * Math.max(1, Math.ceil(bricks / per));
    const out = new Uint8Array(width * height * count);
    channels.forEach((codes, channel) => {
      for (let brick = 0; brick < bricks; brick++) {
        const corner = Math.floor(brick / per) * 8 * width + (brick % per) * 8;
        for (let y = 0; y < 8; y++)
          for (let x = 0; x < 8; x++)
            out[(corner + y * width + x) * count + channel] = codes[brick * 64 + y * 8 + x];
      }
    });
    const [internal, format] = count === 1 ? [gl.R8, gl.RED] : [gl.RGBA8, gl.RGBA];
    this.addTexture(internal, width, height, format, gl.UNSIGNED_BYTE, out, gl.LINEAR);
  }

  uniform(name) { return this.gl.getUniformLocation(this.program, name); }

  setConstants(network) {
    const { gl, row } = this, flat = (f) => row.mpis.flatMap(f);
    gl.useProgram(this.program);
    const disparity = (m) => (m.far === null ? 0 : 1 / m.far);
    gl.uniform3fv(this.uniform("origin"), flat((m) => m.origin));
    gl.uniformMatrix3fv(this.uniform("axes"), false, flat((m) => m.axes.flat()));
    gl.uniform4fv(this.uniform("extent"), flat((m) => m.extent));
    gl.uniform4fv(this.uniform("planes"), flat((m) =>
      [(1 / m.near - disparity(m)) / (m.planes - 1), disparity(m), m.interval, m.planes]));
    gl.uniform4iv(this.uniform("sizes"), flat((m) =>
      [m.height, m.width, Math.ceil((m.height - 1) / 7), Math.ceil((m.width - 1) / 7)]));
    gl.uniform1iv(this.uniform("first"), row.mpis.map((m) => m.first_column));
    gl.uniform1f(this.uniform("rayNear"), row.ray_near);
    gl.uniform1f(this.uniform("threshold"), row.threshold);
    gl.uniform1f(this.uniform("infinity"), 1 / row.farthest);
    gl.uniform1f(this.uniform("background"), row.background);
    gl.uniform3fv(this.uniform("exposure"), row.exposure);
    gl.uniform2f(this.uniform("densityCodes"), row.density.low, row.density.step);
    const padded = (name, by) =>
      Array.from({ length: 4 * this.groups }, (_, c) => (c < 3 ? by : 2 * by) * (row.channels[c]?.[name] ?? 0));
    gl.uniform4fv(this.uniform("low"), padded("low", 1));
    gl.uniform4fv(this.uniform("step_"), padded("step", 255));
    const near = Math.log(row.content_near || row.ray_near || 1e-3);
    gl.uniform2f(this.uniform("depthRange"), near, Math.max(near + 1, Math.log(row.farthest / 10)));
    gl.uniform1i(this.uniform("columns"), 0);
    gl.uniform1i(this.uniform("density"), 1);
    gl.uniform1iv(this.uniform("texels"), Array.from({ length: this.groups }, (_, g) => 2 + g));
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.buffer);
    gl.bufferData(gl.UNIFORM_BUFFER, network, gl.STATIC_DRAW);
  }

  draw(view, share) {
    const { gl } = this;
    gl.useProgram(this.program);
    this.textures.forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE0 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, this.buffer);
    gl.uniform3fv(this.uniform("eye"), view.eye);
    gl.uniformMatrix3fv(this.uniform("turn"), false, view.turn);
    gl.uniform4fv(this.uniform("lens"), view.lens);
    gl.uniform1f(this.uniform("rows"), view.height);
    gl.uniform1i(this.uniform("mode"), view.mode);
    gl.uniform1i(this.uniform("alone"), view.alone);
    gl.uniform1f(this.uniform("share"), share);
    if (this.detailed) this.details.bind((name) => this.uniform(name), this.textures.length, view.detailed);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  freeTextures() {
    for (const texture of this.textures.splice(0)) this.gl.deleteTexture(texture);
  }

  free() {
    this.freed = true;
    this.freeTextures();
    this.gl.deleteProgram(this.program);
    this.gl.deleteBuffer(this.buffer);
  }
}

// Share of each window in a ray that starts at `eye` (as scene/windows.py): full in its ball, falling off beyond.
function windowShares(rows, eye) {
  const beyond = rows.map((r) => Math.hypot(...r.center.map((c, a) => c - eye[a])) - r.radius);
  const raw = rows.map((r, w) => Math.min(1, Math.max(0, 1 - beyond[w] / r.margin)));
  const total = raw.reduce((a, b) => a + b, 0);
  if (total > 0) return raw.map((x) => x / total);
  const nearest = beyond.indexOf(Math.min(...beyond));
  return rows.map((_, w) => (w === nearest ? 1 : 0));
}
