// Equations, as pymdownx.arithmatex leaves them: \(...\) in a span, \[...\] in a div.
for (const place of document.querySelectorAll(".arithmatex")) {
  const source = place.textContent.trim().slice(2, -2);
  katex.render(source, place, { displayMode: place.tagName === "DIV" });
}

// Before and after: two pictures become one, with a line between them that is dragged, or moved by the arrow keys.
for (const pair of document.querySelectorAll(".compare")) {
  const place = pair.querySelector("p");
  const [first, second] = place.querySelectorAll("img");
  const slider = document.createElement("input");
  Object.assign(slider, { type: "range", min: 0, max: 100, value: 50, step: "any" });
  slider.setAttribute("aria-label", `${first.alt}, left of the line; ${second.alt}, right of it`);
  slider.addEventListener("input", () => place.style.setProperty("--at", `${slider.value}%`));
  place.append(slider);
  pair.classList.add("is-live");
}
