// The canvas: a frame, its masks, and annotations on top; zoom, pan, and conversion between pointer and image coordinates.
// Pixel centers are at integer coordinates, so a pixel covers half a unit on each side.

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.frame = null;
    this.overlay = null;
    this.showOverlay = true;
    this.mode = null; // has paint(context, view), and down, move, up, hover, double with (image point, event)
    this.scale = 1;
    this.origin = [0, 0];
    this.fitted = true;
    this.size = [1, 1];
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.up(event));
    canvas.addEventListener("pointercancel", () => (this.drag = null));
    canvas.addEventListener("pointerleave", () => this.mode?.hover?.(null));
    canvas.addEventListener("dblclick", (event) => this.mode?.double?.(this.toImage(event)));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  setSize(width, height) {
    if (this.size[0] === width && this.size[1] === height) return;
    this.size = [width, height];
    this.fit();
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.fitted) this.fit();
    else this.draw();
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.scale = Math.max(0.05, Math.min((width - 16) / this.size[0], (height - 16) / this.size[1]));
    this.origin = [(width - this.scale * this.size[0]) / 2, (height - this.scale * this.size[1]) / 2];
    this.fitted = true;
    this.draw();
  }

  // From an image point to the canvas, CSS pixels.
  toCanvas([x, y]) {
    return [this.origin[0] + (x + 0.5) * this.scale, this.origin[1] + (y + 0.5) * this.scale];
  }

  // From an image point to the window; for tests and the console.
  toWindow(point) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = this.toCanvas(point);
    return [box.left + x, box.top + y];
  }

  // From an event to an image point, kept inside the image.
  toImage(event) {
    const box = this.canvas.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    return [0, 1].map((k) => {
      const value = (at[k] - this.origin[k]) / this.scale - 0.5;
      return Math.round(10 * Math.min(Math.max(value, 0), this.size[k] - 1)) / 10;
    });
  }

  draw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      this.paint();
    });
  }

  paint() {
    const ratio = window.devicePixelRatio || 1;
    const { context, canvas, scale, origin, size } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    context.imageSmoothingEnabled = scale < 2.5;
    const place = [...origin, size[0] * scale, size[1] * scale];
    if (this.frame) context.drawImage(this.frame, ...place);
    if (this.frame && this.overlay && this.showOverlay) {
      context.imageSmoothingEnabled = false;
      context.drawImage(this.overlay, ...place);
    }
    if (this.frame) this.mode?.paint(context, this);
  }

  wheel(event) {
    event.preventDefault();
    const box = this.canvas.getBoundingClientRect();
    const at = [event.clientX - box.left, event.clientY - box.top];
    const next = Math.min(Math.max(this.scale * Math.exp(-0.0015 * event.deltaY), 0.2), 60);
    this.origin = this.origin.map((value, k) => at[k] - ((at[k] - value) * next) / this.scale);
    this.scale = next;
    this.fitted = false;
    this.draw();
  }

  down(event) {
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    const pans = event.button === 1 || event.button === 2 || event.shiftKey;
    this.drag = { pans, at: [event.clientX, event.clientY] };
    if (!pans && event.button === 0 && this.frame) this.mode?.down?.(this.toImage(event), event);
  }

  move(event) {
    if (this.drag?.pans) {
      this.origin = this.origin.map((value, k) => value + [event.clientX, event.clientY][k] - this.drag.at[k]);
      this.drag.at = [event.clientX, event.clientY];
      this.fitted = false;
      this.draw();
    } else if (this.drag) this.mode?.move?.(this.toImage(event), event);
    else this.mode?.hover?.(this.toImage(event));
  }

  up(event) {
    if (this.drag && !this.drag.pans) this.mode?.up?.(this.toImage(event), event);
    this.drag = null;
  }
}
