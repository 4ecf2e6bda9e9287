// Equations, as pymdownx.arithmatex leaves them: \(...\) in a span, \[...\] in a div.
for (const place of document.querySelectorAll(".arithmatex")) {
  const source = place.textContent.trim().slice(2, -2);
  katex.render(source, place, { displayMode: place.tagName === "DIV" });
}
