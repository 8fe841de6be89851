// Sorts and filters tables and plays videos in step. The page is readable without this script.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  if (body.rows.length < 3) continue;
  const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  const key = (row, column) => {
    const cell = row.cells[column];
    const text = cell.dataset.value ?? cell.textContent.trim();
    const number = parseFloat(text);
    return Number.isNaN(number) ? text : number;
  };
  heads.forEach((head, column) => {
    if (head.tagName !== "TH") return;
    const button = document.createElement("button");
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const rows = [...body.rows].sort((a, b) => {
        const [x, y] = [key(a, column), key(b, column)];
        // Texts come last in both directions.
        if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1;
        const order = typeof x === "number" ? x - y : x.localeCompare(y);
        return down ? -order : order;
      });
      body.append(...rows);
    });
  });
  if (body.rows.length >= 8) {
    const search = Object.assign(document.createElement("input"), { type: "search", placeholder: "Filter rows" });
    search.setAttribute("aria-label", "Filter rows");
    search.addEventListener("input", () => {
      const words = search.value.toLowerCase().split(/\s+/);
      for (const row of body.rows) row.hidden = !words.every((word) => row.textContent.toLowerCase().includes(word));
    });
    table.parentElement.before(search);
  }
}
// The videos of a group share one control and play while they are visible.
const make = (kind, facts, ...inside) => {
  const made = Object.assign(document.createElement(kind), facts);
  made.append(...inside);
  return made;
};
for (const group of document.querySelectorAll(".films")) {
  for (const same of group.querySelectorAll("video.same")) {
    const first = group.querySelector("video[src]");
    if (first) [same.src, same.closest("figure").hidden] = [first.src, false];
  }
  const films = [...group.querySelectorAll("video[src]")];
  if (!films.length) continue;
  const [first] = films;
  const button = make("button", { type: "button" });
  const slider = make("input", { type: "range", min: 0, max: 1, step: 0.001, value: 0 });
  const speed = make("select", {}, ...[1, 0.5, 0.25].map((rate) => make("option", { value: rate }, `${rate} ×`)));
  slider.setAttribute("aria-label", "Time of all videos");
  speed.setAttribute("aria-label", "Playback speed");
  for (const film of films) Object.assign(film, { controls: false, loop: false });
  const label = () => (button.textContent = first.paused ? "▶ Play" : "❚❚ Pause");
  const seek = (time) => films.forEach((film) => (film.currentTime = Math.min(time, film.duration || time)));
  const play = () => Promise.allSettled(films.map((film) => film.play())).then(label);
  const pause = () => (films.forEach((film) => film.pause()), seek(first.currentTime), label());
  let wanted = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  button.addEventListener("click", () => ((wanted = first.paused), wanted ? play() : pause()));
  slider.addEventListener("input", () => ((wanted = false), (first.currentTime = slider.value * first.duration), pause()));
  speed.addEventListener("change", () => films.forEach((film) => (film.playbackRate = +speed.value)));
  first.addEventListener("ended", () => wanted && (seek(0), play()));
  first.addEventListener("timeupdate", () => {
    slider.value = first.currentTime / (first.duration || 1);
    for (const film of films) if (Math.abs(film.currentTime - first.currentTime) > 0.08) film.currentTime = first.currentTime;
  });
  new IntersectionObserver(([seen]) => (seen.isIntersecting && wanted ? play() : pause())).observe(group);
  label();
  const control = make("div", { className: "control", style: group.style.cssText }, button, slider, speed);
  group.before(control);
}
// A link into a folded section unfolds the section.
const reveal = () => {
  let element = location.hash && document.getElementById(location.hash.slice(1));
  if (element) element.querySelector(":scope > details.part")?.setAttribute("open", "");
  for (; element; element = element.parentElement) if (element.tagName === "DETAILS") element.open = true;
};
addEventListener("hashchange", reveal);
reveal();
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((fold) => (fold.open = true)));
