// A control for one value: a slider with a number, a switch or a choice. What it may be comes from the server.
import { digits, el } from "./dom.js";

const STEPS = 1000;

// Where a slider's positions lie in a range: evenly, or closer together near zero where the usual values are a small part of the range.
export function scaleOf(c) {
  const open = (v, side) => (c[`open_${side}`] ? v + (side === "low" ? 1 : -1) * 1e-6 * (c.high - c.low) : v);
  const [low, high] = [open(c.low, "low"), open(c.high, "high")];
  const usual = Math.max(Math.abs(c.typical ?? 0), Math.abs(c.bound ?? 0), Math.abs(c.value ?? 0)) || (high - low) / 10;
  if (high - low <= 20 * usual) {
    return { low, high, value: (t) => low + (t / STEPS) * (high - low), place: (v) => (STEPS * (v - low)) / (high - low) };
  }
  const s = usual / 20, [a, b] = [Math.asinh(low / s), Math.asinh(high / s)];
  const inside = (v) => Math.min(Math.max(v, low), high);
  return { low, high, value: (t) => (t >= STEPS ? high : t <= 0 ? low : inside(s * Math.sinh(a + (t / STEPS) * (b - a)))), place: (v) => (STEPS * (Math.asinh(v / s) - a)) / (b - a) };
}

let count = 0;

// ``c`` is the server's control with ``value``; ``put(value)`` is called as it moves, with null for "not given".
export function control(c, put, words = {}) {
  const id = `c${count++}`;
  const name = words.title ?? c.name.replaceAll("_", " ");
  const box = el("div", { class: "control", "data-name": words.key ?? c.name });
  const label = el("label", { for: id }, name, c.text ? el("small", {}, ` – ${c.text}`) : null);
  if (c.kind === "bool") {
    const input = el("input", { type: "checkbox", id, checked: Boolean(c.value), onchange: () => put(input.checked) });
    box.append(el("div", { class: "switch label" }, input, label));
    return { box, show: (v) => { input.checked = Boolean(v); } };
  }
  box.append(label);
  if (c.kind === "choice") {
    const input = el("select", { id, onchange: () => put(c.choices[input.selectedIndex]) }, c.choices.map((v) => el("option", {}, String(v))));
    input.selectedIndex = Math.max(c.choices.indexOf(c.value), 0);
    box.append(input);
    return { box, show: (v) => { input.selectedIndex = Math.max(c.choices.indexOf(v), 0); } };
  }
  if (c.kind === "fixed" || c.low === null || c.high === null || c.low === undefined) {
    box.append(el("span", { class: "hint label" }, c.value?.length ? `a table of ${c.value.length} entries: change it in the camera file` : "no table: give one in the camera file"));
    return { box, show: () => {} };
  }
  const scale = scaleOf(c), whole = c.kind === "int";
  const number = el("input", { type: "number", id: `${id}n`, step: "any", "aria-label": `${name}, number`, min: c.low, max: c.high });
  const slider = el("input", { type: "range", id, min: 0, max: STEPS, step: 1 });
  const show = (v) => {
    number.value = v === null || v === undefined ? "" : digits(v, 6);
    if (v !== null && v !== undefined) slider.value = Math.round(scale.place(v));
    slider.setAttribute("aria-valuetext", v === null || v === undefined ? "not given" : `${digits(v, 4)} ${c.unit}`);
  };
  const moved = () => {
    let v = scale.value(Number(slider.value));
    v = whole ? Math.round(v) : Number(slider.value) % STEPS === 0 ? v : Number(v.toPrecision(4));
    number.value = digits(v, 6);
    slider.setAttribute("aria-valuetext", `${digits(v, 4)} ${c.unit}`);
    put(v);
  };
  slider.addEventListener("input", moved);
  number.addEventListener("change", () => {
    if (number.value === "" && c.none) return put(null);
    const v = Number(number.value);
    if (number.value === "" || !Number.isFinite(v)) return show(c.value);
    slider.value = Math.round(scale.place(v));
    put(whole ? Math.round(v) : v);
  });
  const track = el("div", { class: "track" }, slider);
  for (const mark of ["typical", "bound"]) {
    const v = c[mark];
    if (typeof v !== "number" || (mark === "bound" && v === c.typical)) continue;
    const at = Math.min(Math.max(scale.place(v) / STEPS, 0), 1);
    const made = el("span", { class: `mark ${mark}`, title: `${mark}: ${digits(v, 4)} ${c.unit}` }, `${mark} ${digits(v, 3)}`);
    made.style.left = `calc(${(100 * at).toFixed(2)}% + ${(8 - 16 * at).toFixed(1)}px)`;
    if (at < 0.12) made.style.transform = "translateX(-8%)";
    if (at > 0.88) made.style.transform = "translateX(-92%)";
    made.classList.toggle("second", mark === "bound");
    if (mark === "bound" && typeof c.typical === "number" && Math.abs(at - scale.place(c.typical) / STEPS) < 0.22) made.classList.add("lower"), track.classList.add("deep");
    track.append(made);
  }
  box.append(track, el("div", { class: "value" }, number, el("span", { class: "unit" }, c.unit === "1" ? "" : c.unit)));
  if (c.none) number.placeholder = "not given";
  show(c.value);
  return { box, show };
}
