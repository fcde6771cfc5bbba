// Two pictures of one view side by side, and the dials.
for (const pair of document.querySelectorAll(".pair")) {
  const split = pair.querySelector(".split"), pictures = [...pair.querySelectorAll("img")];
  const sides = pair.parentElement.querySelectorAll("select");
  let at = 0.5;
  const show = () => {
    pictures.forEach(picture => {
      const left = picture.dataset.name === sides[0].value, right = picture.dataset.name === sides[1].value;
      picture.hidden = !left && !right;
      picture.style.zIndex = left ? 1 : 0;
      picture.style.clipPath = left && !right ? `inset(0 ${100 * (1 - at)}% 0 0)` : "none";
    });
    split.style.left = 100 * at + "%";
    split.style.zIndex = 2;
  };
  const move = event => {
    const box = pair.getBoundingClientRect();
    at = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    show();
  };
  pair.addEventListener("pointerdown", event => { pair.setPointerCapture(event.pointerId); move(event); });
  pair.addEventListener("pointermove", event => event.buttons && move(event));
  pair.addEventListener("keydown", event => {
    at = Math.min(1, Math.max(0, at + ({ArrowLeft: -0.05, ArrowRight: 0.05}[event.key] || 0)));
    show();
  });
  sides.forEach(side => side.addEventListener("change", show));
  show();
}
document.querySelectorAll(".dial").forEach(startDial);
