// Details: residuals of training images near the camera. Decoded when a camera comes near them.
"use strict";

const COARSE = 4; // rows and columns of an image for each of its depths
const SPARE = 2; // images on the card beyond those that a picture takes details from

class Details {
  // `changed` is called when an image has come.
  constructor(gl, header, changed) {
    const { nearest: most, step } = header.details || { nearest: 0, step: 1 };
    const sizes = header.windows.flatMap((row) => row.views.map((view) => view.size));
    const size = [0, 1].map((axis) => Math.max(...sizes.map((s) => s[axis])));
    const nearest = Math.max(...size) <= gl.getParameter(gl.MAX_TEXTURE_SIZE) ? most : 0; // larger ones show the field alone
    Object.assign(this, { gl, nearest, step, changed, views: [], layers: [], pending: new Set() });
    if (!nearest) return;
    this.textures = [size, size.map((x) => Math.ceil(x / COARSE))].map((wh) => this.addArray(...wh, nearest + SPARE));
    this.layers = Array.from({ length: nearest + SPARE }, () => null); // the view that each holds
  }

  addArray(width, height, layers) {
    const { gl } = this, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, width, height, layers);
    setSampling(gl, gl.TEXTURE_2D_ARRAY, gl.LINEAR);
    return texture;
  }

  // Takes the images of a window, from bytes that begin behind its bricks.
  add(row, bytes) {
    if (!this.nearest) return;
    const part = ({ offset, bytes: length }) => new Blob([bytes.subarray(offset - row.bricks_bytes, offset - row.bricks_bytes + length)]);
    for (const view of row.views) {
      const { camera } = view, column = (i) => [camera[i], camera[4 + i], camera[8 + i]];
      this.views.push({ ...view, row, parts: [part(view.difference), part(view.inverse)], eye: column(3), turn: [0, 1, 2].flatMap(column) });
    }
    this.changed();
  }

  remove(row) {
    this.views = this.views.filter((view) => view.row !== row);
    this.layers = this.layers.map((view) => (view && view.row === row ? null : view));
  }

  // The images that a camera takes details from, and the factors on their weights: the nearest ones that face alike, less
  // the nearer they are to being the next one, so that none appears at once.
  chosen(camera) {
    const back = camera.axes[2], alike = Math.cos((MAX_ANGLE * Math.PI) / 180);
    const near = this.views.filter((view) => dot(view.turn.slice(6), back) > alike)
      .map((view) => ({ view, far: Math.hypot(...add(view.eye, camera.eye, -1)) }))
      .sort((a, b) => a.far - b.far);
    const limit = near[this.nearest]?.far || Infinity;
    return near.slice(0, this.nearest).map(({ view, far }) => ({ view, share: (1 - (far / limit) ** 2) ** 2 }));
  }

  // Puts the images that a camera needs on the card.
  feed(camera) {
    const chosen = this.chosen(camera).map(({ view }) => view);
    for (const view of chosen) if (!this.layers.includes(view) && !this.pending.has(view)) this.load(view);
    this.needed = chosen;
  }

  async load(view) {
    const { gl } = this;
    this.pending.add(view);
    try {
      const plain = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
      const images = await Promise.all(view.parts.map((blob) => createImageBitmap(blob, plain)));
      const layer = this.layers.findIndex((other) => !other || !this.needed.includes(other));
      if (layer >= 0 && this.views.includes(view)) {
        gl.activeTexture(gl.TEXTURE0);
        images.forEach((image, i) => {
          gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.textures[i]);
          gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, layer, image.width, image.height, 1, gl.RGBA, gl.UNSIGNED_BYTE, image);
        });
        this.layers[layer] = view;
        this.changed();
      }
      for (const image of images) image.close();
    } catch (error) {
      refuse(new Refusal(`A file of this scene is damaged (${error.message}): copy it anew, or export the scene again.`));
    }
    this.pending.delete(view);
  }

  // Uniforms and textures of a picture, for the program in use; none where it shows the field alone.
  bind(uniform, unit, camera) {
    const { gl } = this, selected = camera ? this.chosen(camera).filter(({ view }) => this.layers.includes(view)) : [];
    const four = (name, f) => { if (selected.length) gl.uniform4fv(uniform(name), selected.flatMap(f)); };
    gl.uniform1i(uniform("seen"), selected.length);
    gl.uniform1f(uniform("seenStep"), this.step);
    four("seenImage", ({ view, share }) => [...view.size, this.layers.indexOf(view), share]);
    four("seenEye", ({ view }) => [...view.eye, view.most]);
    four("seenLens", ({ view }) => view.camera.slice(12, 16));
    four("seenBend", ({ view }) => view.camera.slice(16, 20));
    four("seenRest", ({ view }) => view.camera.slice(20, 24));
    if (selected.length) gl.uniformMatrix3fv(uniform("seenTurn"), false, selected.flatMap(({ view }) => view.turn));
    ["differences", "depths"].forEach((name, i) => {
      gl.activeTexture(gl.TEXTURE0 + unit + i);
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.textures[i]);
      gl.uniform1i(uniform(name), unit + i);
    });
  }
}
