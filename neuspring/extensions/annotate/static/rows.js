// A row of a list in the panel: a colored sign, a text, and actions for clicks on the row and on its cross.

export function row({ sign, text, chosen = false, pick, name = text, remove = null }) {
  const item = document.createElement("li");
  item.classList.toggle("chosen", chosen);
  item.append(sign, element("span", text));
  if (remove) {
    const cross = element("button", "✕");
    cross.ariaLabel = `Remove ${name}`;
    cross.onclick = (event) => {
      event.stopPropagation();
      remove();
    };
    item.append(cross);
  }
  item.onclick = pick;
  return item;
}

export function swatch(label) {
  const sign = document.createElement("i");
  sign.className = `swatch ${label}`;
  return sign;
}

function element(kind, text) {
  const made = document.createElement(kind);
  made.textContent = text;
  return made;
}
