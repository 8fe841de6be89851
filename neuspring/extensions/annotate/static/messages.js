// Messages: errors stay until the user closes them, successes disappear after a while.

const place = document.getElementById("messages");

export function say(text, kind = "bad", actions = {}) {
  for (const old of [...place.children]) if (old.dataset.text === text || old.classList.contains("good")) old.remove();
  const line = document.createElement("div");
  line.className = kind;
  line.dataset.text = text;
  const words = document.createElement("span");
  words.textContent = text;
  line.append(words);
  for (const [name, act] of Object.entries({ ...actions, Close: () => {} })) {
    const button = document.createElement("button");
    button.textContent = name;
    button.onclick = () => {
      line.remove();
      act();
    };
    line.append(button);
  }
  place.append(line);
  if (kind === "good") setTimeout(() => line.remove(), 12000);
  return line;
}

export const guard = (act) => async (...values) => {
  try {
    return await act(...values);
  } catch (error) {
    say(error.message);
    if (error.status === undefined) console.error(error);
    return undefined;
  }
};

export function saved(text) {
  document.getElementById("saved").textContent = text;
}
