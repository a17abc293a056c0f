// One clip at a time: the video moves a cursor through the strip; strip, slider, events and arrow keys move the video.
for (const clip of document.querySelectorAll(".clip")) {
  const video = clip.querySelector("video"), strip = clip.querySelector("svg.strip");
  const cursor = strip.querySelector(".cursor"), readout = clip.querySelector(".readout");
  const transport = clip.querySelector(".transport"), play = clip.querySelector(".play");
  const slider = transport.querySelector("input");
  const fps = Number(clip.dataset.fps), last = Number(clip.dataset.last), values = JSON.parse(clip.dataset.values);
  const x0 = Number(strip.dataset.x0), x1 = Number(strip.dataset.x1);
  const number = (value, digits) => (value === null ? "–" : value.toFixed(digits));
  const step = () => Math.max(0, Math.min(last, Math.floor(video.currentTime * fps + 0.001)));
  const show = () => {
    const k = step(), x = x0 + (k / last) * (x1 - x0);
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
    slider.value = k;
    readout.innerHTML =
      `<b>step ${k}</b> · R real <b>${number(values.real[k], 2)}</b> · R imagined <b>${number(values.imagined[k], 2)}</b>` +
      ` · gripper ${number(values.gripper[k], 2)} · moving pixels ${number(values.psnr[k], 1)} dB`;
  };
  const go = (k) => {
    video.pause();
    video.currentTime = (Math.max(0, Math.min(last, k)) + 0.5) / fps;
  };
  const at = (event) => {
    const box = strip.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * strip.viewBox.baseVal.width;
    go(Math.round(((x - x0) / (x1 - x0)) * last));
  };
  const follow = () => {
    show();
    if (!video.paused) requestAnimationFrame(follow);
  };
  const toggle = () => (video.paused ? video.play() : video.pause());
  const sign = () => {
    play.textContent = video.paused ? "▶" : "❚❚";
    play.setAttribute("aria-label", video.paused ? "play" : "pause");
  };
  video.controls = false; // they would cover a picture this small
  transport.hidden = false;
  video.addEventListener("play", follow);
  for (const name of ["play", "pause"]) video.addEventListener(name, sign);
  for (const name of ["seeked", "timeupdate", "loadeddata"]) video.addEventListener(name, show);
  video.addEventListener("click", toggle);
  play.addEventListener("click", toggle);
  slider.addEventListener("input", () => go(Number(slider.value)));
  for (const button of clip.querySelectorAll("[data-step]")) button.addEventListener("click", () => go(Number(button.dataset.step)));
  strip.addEventListener("pointerdown", at);
  strip.addEventListener("pointermove", (event) => event.buttons && at(event));
  clip.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    event.preventDefault();
    go(step() + by * (event.shiftKey ? 8 : 1));
  });
  show();
}
