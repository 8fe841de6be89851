// Requests to the server. The token from the address goes into a header, which other sites cannot send.

const token = location.hash.slice(1) || sessionStorage.getItem("token") || "";
sessionStorage.setItem("token", token);

export class Problem extends Error {
  constructor(status, text) {
    super(text);
    this.status = status;
  }
}

async function ask(path, options = {}) {
  let answer;
  try {
    answer = await fetch(path, { ...options, headers: { "X-NeuSpring-Token": token, ...options.headers } });
  } catch {
    throw new Problem(0, "The server does not answer. Is neuspring annotate still running?");
  }
  if (answer.ok) return answer;
  let text = answer.statusText;
  try {
    text = (await answer.json()).error;
  } catch { /* not a response of this server */ }
  throw new Problem(answer.status, text);
}

export const getJson = async (path) => (await ask(path)).json();
export const getImage = async (path) => createImageBitmap(await (await ask(path)).blob());
const send = (path, values) =>
  ask(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(values) });
export const post = async (path, values = {}) => (await send(path, values)).json();
export const postForImage = async (path, values) => createImageBitmap(await (await send(path, values)).blob());

// Cache of the latest images by path, with at most `most` pixels.
export class Images {
  constructor(most = 60e6) {
    this.kept = new Map();
    this.most = most;
  }

  get(path, pixels) {
    const known = this.kept.get(path);
    if (known) {
      this.kept.delete(path);
      this.kept.set(path, known);
      return known.image;
    }
    const image = getImage(path);
    this.kept.set(path, { image, pixels });
    image.catch(() => this.kept.delete(path));
    let sum = 0;
    for (const one of this.kept.values()) sum += one.pixels;
    for (const [oldest, one] of this.kept) {
      if (sum <= this.most) break;
      sum -= one.pixels;
      this.kept.delete(oldest);
    }
    return image;
  }
}
