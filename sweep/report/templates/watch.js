"use strict";
// Asks for what has changed; tiles are changed in place, so that their colours go over into each other.
(() => {
  const ended = document.getElementById("ended");
  const known = new Map();
  const put = (place, html) => {
    const made = document.createElement("template");
    made.innerHTML = html;
    const [before, after] = [place, made.content].map((one) => [...one.querySelectorAll(".tiles, .tiles > i")]);
    if (after.length && before.length === after.length) {
      after.forEach((one, i) => {
        for (const { name, value } of one.attributes) before[i].setAttribute(name, value);
      });
      return;
    }
    const open = new Set([...place.querySelectorAll("details[open]")].map((one) => one.dataset.key));
    for (const one of made.content.querySelectorAll("details")) one.open = open.has(one.dataset.key);
    place.replaceChildren(made.content);
  };
  const look = async () => {
    try {
      const answer = await fetch("state");
      if (!answer.ok) throw new Error(answer.status);
      for (const [id, html] of Object.entries(await answer.json())) {
        if (known.get(id) !== html) put(document.getElementById(id), html);
        known.set(id, html);
      }
      const shown = document.querySelector(".numbers strong");
      document.title = shown ? `${shown.textContent} · sweep watch` : "sweep watch";
      ended.hidden = true;
    } catch {
      ended.hidden = false;
    }
    setTimeout(look, Number(document.documentElement.dataset.interval));
  };
  for (const kind of ["pointerover", "click"]) {
    document.addEventListener(kind, (event) => {
      if (!event.target.matches(".tiles > i")) return;
      event.target.closest("article").querySelector(".said").textContent = event.target.title;
    });
  }
  look();
})();
