// The frame slider, the strip above it, and playback.

export class Timeline {
  // `go(frame)` resolves when the frame is shown; `bars()` gives [{frame, last?, color, height 0..1}], drawn in this order.
  constructor({ go, bars }) {
    this.go = go;
    this.bars = bars;
    this.slider = document.getElementById("frame");
    this.strip = document.getElementById("strip");
    this.text = document.getElementById("frame-text");
    this.button = document.getElementById("play");
    this.frames = 1;
    this.rate = 30;
    this.playing = false;
    this.slider.addEventListener("input", () => {
      this.stop();
      this.go(Number(this.slider.value));
    });
    this.button.onclick = () => this.toggle();
    new ResizeObserver(() => this.draw()).observe(this.strip);
  }

  set(frames, rate) {
    this.frames = frames;
    this.rate = rate;
    this.slider.max = frames - 1;
  }

  show(frame) {
    this.frame = frame;
    this.slider.value = frame;
    this.text.textContent = `frame ${frame} of 0–${this.frames - 1}`;
    this.draw();
  }

  draw() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [this.strip.clientWidth, this.strip.clientHeight];
    this.strip.width = Math.max(1, width * ratio);
    this.strip.height = Math.max(1, height * ratio);
    const context = this.strip.getContext("2d");
    context.scale(ratio, ratio);
    // The knob of a range input stays half its width inside both ends.
    const knob = 8;
    const step = (width - 2 * knob) / Math.max(this.frames - 1, 1);
    const wide = Math.max(step, 2);
    for (const bar of this.bars()) {
      // Integer pixels, so that neighboring bars leave no gap.
      const left = Math.floor(knob + bar.frame * step - wide / 2);
      const right = Math.floor(knob + (bar.last ?? bar.frame) * step + wide / 2);
      context.fillStyle = bar.color;
      context.fillRect(left, height * (1 - bar.height), right - left, height * bar.height);
    }
    context.fillStyle = "#e4e7eb";
    context.fillRect(knob + (this.frame ?? 0) * step - 0.5, 0, 1, height);
  }

  stop() {
    this.playing = false;
    this.button.textContent = "▶";
    this.button.setAttribute("aria-label", "Play");
  }

  async toggle() {
    if (this.playing) return this.stop();
    this.playing = true;
    this.button.textContent = "❚❚";
    this.button.setAttribute("aria-label", "Stop");
    if (this.frame >= this.frames - 1) await this.go(0);
    while (this.playing && this.frame < this.frames - 1) {
      const start = performance.now();
      await this.go(this.frame + 1);
      const left = 1000 / this.rate - (performance.now() - start);
      await new Promise((done) => setTimeout(done, Math.max(left, 0)));
    }
    return this.stop();
  }
}
