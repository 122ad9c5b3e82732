// The page: loading, the camera, controls, and how sharply to draw.
"use strict";

const $ = (id) => document.getElementById(id);
const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / Math.hypot(...a));
const WHILE_MOVING = 1 / 40, AT_REST = 1; // seconds that a frame may take
const LEAST_SCALE = 0.1;
const START = 1 / 6; // place among the training cameras where the page opens, as nerfstudio's viewer (mmpi_ns/viewer.py)
const MOST_WINDOWS = 4; // on the card at once, unless the camera needs more

function rotated(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), k = cross(axis, v);
  return v.map((x, i) => x * c + k[i] * s + axis[i] * dot(axis, v) * (1 - c));
}

// A camera: where it stands, its axes (right, up, back), and its lens for an image of `size` pixels.
function cameraOf(pose) {
  const column = (i) => pose.to_world.map((row) => row[i]);
  return { eye: column(3), axes: [column(0), column(1), column(2)], size: pose.size, focal: pose.focal, center: pose.center };
}

function between(a, b, t) {
  const mix = (x, y) => x.map((v, i) => v * (1 - t) + y[i] * t);
  const back = unit(mix(a.axes[2], b.axes[2])), right = unit(cross(mix(a.axes[1], b.axes[1]), back));
  return { ...a, eye: mix(a.eye, b.eye), axes: [right, cross(back, right), back] };
}

class Page {
  constructor(gl, header) {
    Object.assign(this, { gl, header, mode: 0, alone: null, playing: null, moved: 0, dirty: true });
    // `alone` is {window, head} of the one MPI to show, or null for all of them.
    this.cost = 1e-5; // seconds a pixel, as the last frame took
    this.keys = new Set();
    this.details = new Details(gl, header, () => { this.dirty = true; });
    this.windows = new Map(); // on the card, by number, least recently needed first; null while it is on its way
    this.path = header.path.map(cameraOf);
    const training = this.path.map((_, i) => i).filter((i) => !header.path[i].test);
    this.start = training[Math.round(START * (training.length - 1))] || 0; // number of a camera
    $("place").max = this.path.length - 1;
    this.go(this.start);
    const steps = this.path.slice(1).map((c, i) => Math.hypot(...add(c.eye, this.path[i].eye, -1)));
    const near = header.windows[0].content_near || 1, length = steps.reduce((a, b) => a + b, 0);
    this.pace = Math.min(near / Math.max(length, 1e-6) * steps.length, 4); // of Play, cameras a second
    this.speed = Math.max(4 * (steps.sort((a, b) => a - b)[steps.length >> 1] || 0), near / 4); // a second
  }

  // Fetches the windows that the camera needs, and frees the least recently needed others beyond MOST_WINDOWS.
  async feed() {
    const shares = windowShares(this.header.windows, this.camera.eye);
    const ahead = windowShares(this.header.windows, add(this.camera.eye, this.camera.axes[2], -this.speed));
    for (let w = 0; w < shares.length; w++) {
      if (shares[w] <= 0 && ahead[w] <= 0) continue;
      const window = this.windows.get(w);
      this.windows.delete(w);
      this.windows.set(w, window || null);
      if (window === undefined) await this.load(w, this.header.windows[w]).catch(refuse);
    }
    for (const [w, window] of this.windows)
      if (window && this.windows.size > MOST_WINDOWS && shares[w] === 0 && ahead[w] === 0) {
        window.free();
        this.details.remove(window.row);
        this.windows.delete(w);
      }
    this.details.feed(this.camera);
  }

  // Draws a window from the first part of its file on; the rest follows.
  async load(w, row) {
    const told = (part) => {
      if (failed()) return;
      if (part < 1) report(`Loading ${this.header.name} … ${Math.round(100 * part)} %`);
      else this.describe();
    };
    const parts = partsOf(row, told), [first, rest, views] = Array.from({ length: 3 }, async () => (await parts.next()).value);
    for (const later of [rest, views]) later.catch(() => {}); // awaited only once the first part is drawn
    const window = await WindowOnCard.load(this.gl, row, await first, this.details);
    this.windows.set(w, window);
    this.dirty = true;
    rest.then((bytes) => window.complete(bytes)).then(() => { told(1); this.dirty = true; return views; })
      .then((bytes) => { if (!window.freed) this.details.add(row, bytes); }).catch(refuse);
  }

  // Draws what a camera sees into the whole canvas of this size.
  draw(camera, width, height) {
    const { gl } = this, canvas = gl.canvas;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const cover = Math.max(width / camera.size[0], height / camera.size[1]);
    const lens = [camera.focal[0] * cover, camera.focal[1] * cover,
      width / 2 + (camera.center[0] - camera.size[0] / 2) * cover, height / 2 + (camera.center[1] - camera.size[1] / 2) * cover];
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    let shares = windowShares(this.header.windows, camera.eye).map((s, w) => (this.windows.get(w) ? s : 0));
    const total = shares.reduce((a, b) => a + b, 0);
    const most = shares.indexOf(Math.max(...shares));
    const alone = this.alone && this.alone.window === most ? this.alone.head : -1;
    const view = { eye: camera.eye, turn: camera.axes.flat(), lens, height, mode: this.mode, alone, detailed: this.mode || alone >= 0 ? null : camera };
    shares.forEach((share, w) => {
      const part = this.mode || alone >= 0 ? Number(w === most) : share / total;
      if (share > 0 && part > 0) this.windows.get(w).draw(view, part);
    });
  }

  // One frame: moves, plays, and draws where something changed; sharper again once nothing moves.
  frame(now) {
    const elapsed = Math.min((now - (this.last ?? now)) / 1000, 0.25);
    this.last = now;
    if (this.move(elapsed) | this.play(elapsed)) this.touched();
    const pixels = [innerWidth, innerHeight].map((x) => x * Math.min(devicePixelRatio || 1, 2));
    const rests = now - this.moved > 250, wanted = (rests ? AT_REST : WHILE_MOVING) / (this.cost * pixels[0] * pixels[1]);
    const scale = Math.min(Math.max(Math.sqrt(wanted), LEAST_SCALE), 1);
    const sharper = rests && this.drawn < 1 && scale > 1.2 * this.drawn;
    if (this.dirty || sharper) {
      this.feed();
      if ([...this.windows.values()].some(Boolean)) {
        const size = pixels.map((x) => Math.max(1, Math.round(x * scale))), begin = performance.now();
        this.draw(this.camera, ...size);
        this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits for the frame
        this.cost = (performance.now() - begin) / 1000 / (size[0] * size[1]);
        this.drawn = scale;
        this.dirty = false;
      }
    }
    $("play").checked = this.playing !== null;
    if (!failed()) requestAnimationFrame((t) => this.frame(t));
  }

  move(elapsed) {
    const held = (key) => Number(this.keys.has(key));
    const [right, up, back] = this.camera.axes, far = this.speed * elapsed * (this.keys.has("Shift") ? 4 : 1);
    const sideways = held("d") + held("ArrowRight") - held("a") - held("ArrowLeft");
    const forward = held("w") + held("ArrowUp") - held("s") - held("ArrowDown");
    const upward = held("e") - held("q");
    if (!sideways && !forward && !upward) return false;
    this.playing = null;
    this.camera.eye = add(add(add(this.camera.eye, right, sideways * far), back, -forward * far), up, upward * far);
    return true;
  }

  play(elapsed) {
    if (this.playing === null) return false;
    this.playing += elapsed * this.pace;
    const last = this.path.length - 1;
    this.go(Math.min(this.playing, last));
    if (this.playing >= last) this.playing = null;
    return true;
  }

  // To a place on the captured path: at whole numbers that of a camera.
  go(place) {
    const last = this.path.length - 1, i = Math.min(Math.floor(place), Math.max(last - 1, 0));
    this.camera = between(this.path[i], this.path[Math.min(i + 1, last)], place - i);
    $("place").value = place;
  }

  turn(dx, dy) { // pixels of the screen: to where one drags, as in nerfstudio's viewer
    this.playing = null;
    const { size, focal } = this.camera, { up } = this.header;
    const angle = -1 / (focal[0] * Math.max(innerWidth / size[0], innerHeight / size[1]));
    let axes = this.camera.axes.map((axis) => rotated(axis, up, dx * angle));
    const tilted = axes.map((axis) => rotated(axis, axes[0], dy * angle));
    if (Math.abs(dot(tilted[2], up)) < 0.98) axes = tilted;
    this.camera.axes = axes;
    this.touched();
  }

  dolly(far) {
    this.playing = null;
    this.camera.eye = add(this.camera.eye, this.camera.axes[2], -far * this.speed);
    this.touched();
  }

  touched() {
    this.moved = performance.now();
    this.dirty = true;
    this.checkAlone();
  }

  // One MPI is shown alone for as long as the camera stays in its window.
  checkAlone() {
    if (!this.alone || this.alone.window === this.nearest()) return;
    this.alone = null;
    this.describe();
  }

  // The window with the largest share where the camera stands.
  nearest() {
    const shares = windowShares(this.header.windows, this.camera.eye);
    return shares.indexOf(Math.max(...shares));
  }

  describe() {
    const shows = ["", "depth", "winning MPI"][this.mode];
    const name = this.alone && this.header.windows[this.alone.window].mpis[this.alone.head].name;
    report([shows, name ? `MPI '${name}' alone` : ""].filter(Boolean).join(", "));
  }

  press(key) {
    const place = Number($("place").value);
    if (key === "p" || key === " ") this.playing = this.playing !== null ? null : place < this.path.length - 1 ? place : 0;
    else if (key === "r" || key === "n") {
      const distances = this.path.map((c) => Math.hypot(...add(c.eye, this.camera.eye, -1)));
      this.playing = null;
      this.go(key === "r" ? this.start : distances.indexOf(Math.min(...distances)));
    }
    else if (key === "1" || key === "2" || key === "3") this.mode = Number(key) - 1;
    else if (key === "m") {
      const window = this.nearest(), head = this.alone ? this.alone.head + 1 : 0;
      this.alone = head < this.header.windows[window].mpis.length ? { window, head } : null;
    }
    else if (key === "h") $("help").hidden = !$("help").hidden;
    else return;
    this.checkAlone();
    this.describe();
    this.dirty = true;
  }
}

function listen(page, canvas) {
  const pointers = new Map();
  canvas.addEventListener("pointerdown", (e) => { pointers.set(e.pointerId, [e.clientX, e.clientY]); canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", (e) => {
    const before = pointers.get(e.pointerId);
    if (!before) return;
    const now = [e.clientX, e.clientY], others = [...pointers].filter(([id]) => id !== e.pointerId).map(([, at]) => at);
    if (others.length === 1) { // two fingers: apart is forward, together is back
      const distance = (at) => Math.hypot(at[0] - others[0][0], at[1] - others[0][1]);
      page.dolly((distance(now) - distance(before)) / 200);
    } else if (!others.length) page.turn(now[0] - before[0], now[1] - before[1]);
    pointers.set(e.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => pointers.delete(e.pointerId));
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); page.dolly(-Math.sign(e.deltaY) * 0.2); }, { passive: false });
  $("place").addEventListener("input", (e) => { page.playing = null; page.go(Number(e.target.value)); page.touched(); });
  $("play").addEventListener("click", () => page.press("p"));
  $("nearest").addEventListener("click", () => page.press("n"));
  const name = (e) => (e.key.length === 1 ? e.key.toLowerCase() : e.key);
  addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    page.keys.add(name(e));
    if (!e.repeat) page.press(name(e));
    if (name(e) === " " || e.key.startsWith("Arrow")) e.preventDefault();
  });
  addEventListener("keyup", (e) => page.keys.delete(name(e)));
  addEventListener("blur", () => page.keys.clear());
  addEventListener("resize", () => { page.dirty = true; });
  canvas.addEventListener("webglcontextlost", () => refuse(new Refusal("The graphics card was reset: reload the page.")));
}

const report = (text) => { $("status").textContent = text; };
const failed = () => document.body.dataset.state === "failed";

function refuse(error) {
  document.body.dataset.state = "failed";
  report(error instanceof Refusal ? error.message : `This page does not work here (${error}): reload it, or try another browser.`);
}

const parsed = new Promise((done) => document.addEventListener("DOMContentLoaded", done));

function decoded(id) {
  const text = atob($(id).textContent.trim()), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// Bytes of a window (its first part, the rest of its bricks, and details) from the page itself where they are in it, else
// from beside it.
async function* partsOf(row, progress) {
  if ($(row.file)) {
    yield decoded(row.file);
    await parsed;
    const later = decoded(`${row.file}.rest`), split = row.bricks_bytes - row.first_bytes;
    yield later.subarray(0, split);
    yield later.subarray(split);
    return;
  }
  const response = await fetch(row.file, { cache: "no-cache" });
  if (!response.ok) throw new Refusal(`${row.file} is missing beside this page: copy the whole folder.`);
  const reader = response.body.getReader(), bytes = new Uint8Array(row.bytes);
  let at = 0, begin = 0;
  for (const end of [row.first_bytes, row.bricks_bytes, row.bytes]) {
    while (at < end) {
      const { done, value } = await reader.read();
      if (done || at + value.length > row.bytes)
        throw new Refusal(`${row.file} is cut short or too long (${row.bytes} bytes are right): copy the whole folder anew.`);
      bytes.set(value, at);
      at += value.length;
      if (at < row.bricks_bytes) progress(at / row.bricks_bytes);
    }
    yield bytes.subarray(begin, end);
    begin = end;
  }
}

async function fetchHeader() {
  const inside = $("scene.json");
  if (!inside && location.protocol === "file:")
    throw new Refusal("A browser does not read files beside a page that was opened from the disk: serve this folder " +
      "(python -m http.server), or export one file with mmpi-export web --single-file.");
  const response = inside ? new Response(inside.textContent) : await fetch("scene.json", { cache: "no-cache" });
  if (!response.ok) throw new Refusal("scene.json is missing beside this page: copy the whole folder.");
  const header = await response.json().catch(() => { throw new Refusal("scene.json is damaged: copy it anew, or export the scene again."); });
  if (header.format !== "mmpi-baked") throw new Refusal("scene.json is not the header of a baked scene.");
  if (header.version !== 5)
    throw new Refusal(`This scene is of version ${header.version}, and this page reads version 5: export it again.`);
  return header;
}

async function main() {
  const gl = $("view").getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) throw new Refusal("This browser has no WebGL2, which this page draws with: switch on hardware acceleration, or try another browser.");
  if (typeof DecompressionStream === "undefined") throw new Refusal("This browser is too old to unpack the scene: any of 2023 or newer can.");
  const page = new Page(gl, await fetchHeader());
  document.title = page.header.name;
  window.mmpi = page; // for tests and tinkering
  await page.feed();
  if (failed()) return;
  listen(page, $("view"));
  document.body.dataset.state = "ready";
  requestAnimationFrame((t) => page.frame(t));
}

main().catch(refuse);
