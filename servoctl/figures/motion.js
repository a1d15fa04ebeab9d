// Moves the drawing that this script stands in: its data hold the points of each shape at each frame.
{
  const figure = document.currentScript.parentElement;
  const { t, fps, speed, shapes, trails } = JSON.parse(figure.querySelector("script[type='application/json']").textContent);
  const [button, slider, clock] = ["button", "input", "output"].map((name) => figure.querySelector(name));
  const moving = figure.querySelectorAll(".moving"), trailing = figure.querySelectorAll(".trail");
  let playing = true, since = null, from = 0;

  const show = (i) => {
    shapes.forEach((frames, k) => moving[k].setAttribute("points", frames[i]));
    trails.forEach((points, k) => trailing[k].setAttribute("points", points.slice(0, i + 1).join(" ")));
    clock.textContent = `t = ${t[i].toFixed(2)} s${speed}`;
    slider.value = i;
  };
  const play = (now) => {
    if (!playing) return;
    since ??= now;
    const i = from + Math.floor(((now - since) / 1000) * fps);
    show(i % t.length);
    requestAnimationFrame(play);
  };
  const start = (yes) => {
    playing = yes;
    [since, from] = [null, Number(slider.value)];
    button.textContent = yes ? "Pause" : "Play";
    if (yes) requestAnimationFrame(play);
  };
  button.onclick = () => start(!playing);
  slider.oninput = () => {
    start(false);
    show(Number(slider.value));
  };
  show(0);
  start(true);
}
