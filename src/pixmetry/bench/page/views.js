// The other views, each asked for when it is open.
import { $, digits, el, mpx, svg } from "./dom.js";
import { Latest } from "./ask.js";
import { plot, screen } from "./draw.js";

const VIEWS = [
  ["flat", "Flat and dark field", "fields", evenFields],
  ["line", "Line of video", "line", videoLine],
  ["hour", "The hour of warming up", "hour", hour],
  ["pixel", "Over a pixel", "pixel", overPixel],
  ["fields", "When the rows look", "rows", exposedRows],
];

let open = "", bench = null, move = null;
const asks = {};
const fill = (...parts) => $("view").replaceChildren(...parts);

export function makeViews(page, moveState) {
  bench = page;
  move = moveState;
  const tabs = VIEWS.map(([id, title, path, draw], k) => {
    asks[id] = new Latest(path, (answer) => { if (open === id) draw(answer); }, (text) => { if (open === id) $("view").replaceChildren(el("p", { class: "hint" }, text)); });
    return el("button", { type: "button", role: "tab", id: `tab-${id}`, "aria-selected": "false", "aria-controls": "view", tabindex: k ? -1 : 0, onclick: () => show(open === id ? "" : id), onkeydown: step }, title);
  });
  $("tabs").replaceChildren(...tabs);
  show("");
}

function step(event) {
  const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!by) return;
  const tabs = [...$("tabs").children], next = tabs[(tabs.indexOf(event.target) + by + tabs.length) % tabs.length];
  next.focus();
  next.click();
}

export function show(id) {
  open = id;
  for (const tab of $("tabs").children) {
    const mine = tab.id === `tab-${id}`;
    tab.setAttribute("aria-selected", String(mine));
    tab.tabIndex = mine || (!id && tab === $("tabs").firstChild) ? 0 : -1;
  }
  stopAnimation();
  $("view").replaceChildren(el("p", { class: "hint" }, id ? "computing …" : "Choose a view: it follows every change."));
  refresh();
}

export function refresh() {
  if (open) asks[open].ask(bench.state);
}

function evenFields(answer) {
  const one = (part, title) => {
    const made = screen(part.picture, `${title}, stretched`, part.stretched);
    return el("figure", {}, made.box, el("figcaption", {}, el("b", {}, title), ` mean ${digits(part.mean_dn, 4)} DN, standard deviation ${digits(part.std_dn, 3)} DN; black is ${digits(part.stretched[0], 4)}, white ${digits(part.stretched[1], 4)} DN`));
  };
  fill(el("div", { class: "side" }, one(answer.flat, "Even field at half of saturation"), one(answer.dark, "Dark field")));
}

function videoLine(answer) {
  const x = [], y = [];
  const half = (answer.sample_us[1] - answer.sample_us[0]) / 2;
  answer.sample_us.forEach((t, k) => { x.push(t - half, t + half); y.push(answer.stored_dn[k], answer.stored_dn[k]); });
  const [from, to] = [answer.video_us[0], answer.video_us.at(-1)];
  const steps = { x: [], y: [] }, pitch = (answer.pixel_us[1] - answer.pixel_us[0]) / 2;
  answer.pixel_us.forEach((t, k) => { if (t > from && t < to) { steps.x.push(t - pitch, t + pitch); steps.y.push(answer.pixel_dn[k], answer.pixel_dn[k]); } });
  fill(
    plot({ lines: [{ x: answer.video_us, y: answer.video_dn, name: "video" }, { x, y, name: "stored" }, { ...steps, name: "pixels of the sensor" }], xLabel: "time in the row / µs", yLabel: "DN", label: "Video of the row through the target against time", height: 220, zero: true }),
    el("p", { class: "hint" }, "The pixels of the sensor go onto the line; filters, cable and grabber make the video of them; the converter samples it. Noise and jitter of the line are at their means."),
  );
}

// The slider stays while the curves are drawn anew: it may be held.
function hour(answer) {
  const now = answer.now_min.map((m) => Math.min(m, 60));
  const curves = [
    el("div", {}, plot({ lines: [{ x: answer.minutes, y: answer.x_px, name: "x" }, { x: answer.minutes, y: answer.y_px, name: "y" }], marks: [{ x: now[0], name: "true" }, { x: now[1], name: "found" }], xLabel: "time since switching on / min", yLabel: "px", label: "Where the target is seen, less where it is seen after an hour" })),
    el("div", {}, plot({ lines: [{ x: answer.minutes, y: answer.temperature_c }], xLabel: "time since switching on / min", yLabel: "sensor / °C", label: "Temperature of the sensor" })),
  ];
  const hint = `At switching on the target is seen at x ${digits(answer.x_px[0], 3)} px, y ${digits(answer.y_px[0], 3)} px from where it is after an hour. Lines: now, of the camera (blue) and of the grabber (orange).`;
  if (!$("hour-slider")) {
    const slider = el("input", { type: "range", min: 0, max: 60, step: 1, id: "hour-slider", oninput: () => { tell(); move({ camera_on_min: Number(slider.value), grabber_on_min: Number(slider.value) }); } });
    const words = el("span"), tell = () => { words.textContent = ` ${slider.value} min`; };
    slider.value = Math.round(Math.min(...now));
    tell();
    fill(el("div", { class: "row" }, el("label", { for: "hour-slider" }, "Camera and grabber on for"), slider, words), el("div", { class: "side", id: "hour-curves" }), el("p", { class: "hint", id: "hour-hint" }));
  }
  $("hour-curves").replaceChildren(...curves);
  $("hour-hint").textContent = hint;
}

function overPixel(answer) {
  const lines = Object.entries(answer.errors_px).map(([name, y]) => ({ x: answer.place_px, y, name: name.replaceAll("_", " ") }));
  fill(plot({ lines, xLabel: "place of the target in the pixel / px", yLabel: "error of x / px", label: "Error of x while the target goes over a pixel", height: 200 }),
    el("p", { id: "ranges" }, "From the lowest error to the highest: ", Object.entries(answer.range_px).map(([name, v]) => `${name.replaceAll("_", " ")} ${v === null ? "–" : mpx(v)}`).join(", "), "."),
    el("p", { class: "hint" }, "Every temporal noise is at its mean: what is left is the same in every frame. A good estimator gives a level line."));
}

let timer = 0;
function stopAnimation() { cancelAnimationFrame(timer); }

function exposedRows(answer) {
  const rows = answer.begin_ms.length, [t0, t1] = [answer.time_ms[0], answer.time_ms.at(-1)];
  const width = 460, height = 260, left = 46, bottom = 230;
  const X = (t) => left + ((t - t0) / (t1 - t0 || 1)) * (width - left - 8), Y = (k) => 8 + (k / rows) * (bottom - 8);
  const chart = svg("svg", { class: "plot", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "Times at which each row is exposed" });
  for (let k = 0; k < rows; k++) chart.append(svg("rect", { x: X(answer.begin_ms[k]), width: Math.max(X(answer.end_ms[k]) - X(answer.begin_ms[k]), 0.6), y: Y(k), height: Math.max((bottom - 8) / rows - 0.3, 0.5), fill: (answer.row0 + k) % 2 ? "var(--red)" : "var(--blue)", opacity: 0.5 }));
  const cursor = svg("path", { class: "axis mark-true" });
  const label = (x, y, words, anchor = "middle") => { const t = svg("text", { x, y, "text-anchor": anchor }); t.textContent = words; chart.append(t); };
  label(width / 2, height - 4, "time / ms");
  for (const t of [t0, (t0 + t1) / 2, t1]) label(X(t), height - 16, digits(t, 3));
  label(left - 4, 16, `row ${answer.row0}`, "end");
  label(left - 4, bottom, `${answer.row0 + rows - 1}`, "end");
  chart.append(cursor);
  const scene = svg("svg", { class: "plot", viewBox: `0 0 ${rows} ${rows}`, role: "img", "aria-label": "The target while the rows look" });
  const middle = answer.path_px[Math.floor(answer.path_px.length / 2)];
  const ground = svg("rect", { width: rows, height: rows, fill: "#000" });
  const looking = svg("g", { opacity: 0.45 }), disc = svg("circle", { r: answer.diameter_px / 2, fill: "#fff" });
  scene.append(ground, looking, disc);
  let at = 0, last = 0;
  const draw = (now) => {
    if (!document.contains(chart) && last) return;
    if (now - last > 60) {
      last = now;
      const share = at / 60, t = t0 + share * (t1 - t0), k = share * (answer.time_ms.length - 1), i = Math.min(Math.floor(k), answer.time_ms.length - 2), f = k - i;
      const [x, y] = [0, 1].map((c) => answer.path_px[i][c] * (1 - f) + answer.path_px[i + 1][c] * f);
      disc.setAttribute("cx", x - middle[0] + rows / 2);
      disc.setAttribute("cy", y - answer.row0);
      cursor.setAttribute("d", `M${X(t)} 8V${bottom}`);
      looking.replaceChildren(...answer.begin_ms.flatMap((b, r) => (b <= t && t <= answer.end_ms[r] ? [svg("rect", { y: r, width: rows, height: 1, fill: (answer.row0 + r) % 2 ? "#f4915a" : "#5fb3ea" })] : [])));
      if (!still) at = (at + 1) % 61;
    }
    if (!still) timer = requestAnimationFrame(draw);
  };
  let still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const button = el("button", { type: "button", onclick: () => { still = !still; button.textContent = still ? "play" : "pause"; stopAnimation(); if (!still) timer = requestAnimationFrame(draw); } }, still ? "play" : "pause");
  stopAnimation();
  setTimeout(() => draw(performance.now()));
  fill(el("div", { class: "side" }, chart, scene), el("div", { class: "row" }, button, el("span", { class: "hint" }, answer.moves ? "Rows that look now are tinted: even rows blue, odd rows red." : "Nothing moves in this scenario: give the target a speed under Motion.")));
}
