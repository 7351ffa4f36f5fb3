// Drawing: grey values on a canvas, centres and errors over it, profiles, curves, bars.
import { digits, el, px, svg } from "./dom.js";

const ENLARGED = 20;

export function codesOf(picture) {
  const raw = atob(picture.data);
  const bytes = Uint8Array.from(raw, (c) => c.charCodeAt(0));
  return new Uint16Array(bytes.buffer);
}

export function paint(canvas, picture, stretched = null) {
  const codes = codesOf(picture);
  canvas.width = picture.cols;
  canvas.height = picture.rows;
  const image = new ImageData(picture.cols, picture.rows);
  const [low, high] = stretched ?? [0, 2 ** picture.bits - 1];
  const scale = 255 / Math.max(high - low, 1e-9);
  for (let k = 0; k < codes.length; k++) {
    const grey = (codes[k] - low) * scale;
    image.data[4 * k] = image.data[4 * k + 1] = image.data[4 * k + 2] = grey;
    image.data[4 * k + 3] = 255;
  }
  canvas.getContext("2d").putImageData(image, 0, 0);
  return codes;
}

export function screen(picture, label, stretched = null) {
  const canvas = el("canvas", { role: "img", "aria-label": label });
  const over = svg("svg", { viewBox: `-0.5 -0.5 ${picture.cols} ${picture.rows}`, preserveAspectRatio: "none", "aria-hidden": "true" });
  const box = el("div", { class: "screen" }, canvas, over);
  paint(canvas, picture, stretched);
  return { box, canvas, over };
}

// True and found centre, the ellipse of the found one and the error, both enlarged.
export function drawFound(over, picture, found) {
  over.replaceChildren();
  if (!found?.true_px) return;
  const at = (p) => [p[0] - picture.col0, p[1] - picture.row0];
  const size = picture.cols / 40;
  const cross = (p, name) => {
    const [x, y] = at(p);
    over.append(svg("path", { class: name, d: `M${x - size} ${y}H${x + size}M${x} ${y - size}V${y + size}`, "stroke-width": picture.cols / 300, fill: "none" }));
  };
  cross(found.true_px, "true");
  if (!found.found_px) return;
  cross(found.found_px, "found");
  const [x, y] = at(found.true_px);
  const [dx, dy] = found.error_px.map((v) => v * ENLARGED);
  over.append(svg("path", { class: "vector", d: `M${x} ${y}l${dx} ${dy}`, "stroke-width": picture.cols / 160, fill: "none" }));
  const [a, b, angle] = ellipse(found.covariance_px2);
  over.append(
    svg("ellipse", {
      class: "vector", fill: "none", "stroke-width": picture.cols / 300, rx: 2 * ENLARGED * a, ry: 2 * ENLARGED * b,
      transform: `translate(${x + dx} ${y + dy}) rotate(${angle})`,
    }),
  );
}

function ellipse([xx, xy, yy]) {
  const mean = (xx + yy) / 2;
  const half = Math.hypot((xx - yy) / 2, xy);
  const angle = (Math.atan2(2 * xy, xx - yy) / 2) * (180 / Math.PI);
  return [Math.sqrt(Math.max(mean + half, 0)), Math.sqrt(Math.max(mean - half, 0)), angle];
}

export function errorText(found) {
  if (!found) return "";
  if (!found.found_px) return found.reason;
  const [x, y] = found.error_px;
  return `error x ${digits(x, 3)} px, y ${digits(y, 3)} px; stated u ${px(found.u_px)}`;
}

// Lines over a common axis: ``lines`` are {x, y, name?}; ``marks`` are {x, name, text}.
export function plot({ lines, marks = [], xLabel, yLabel, label, height = 150, zero = false }) {
  const width = 460, left = 46, right = 8, top = 8, bottom = 30;
  const finite = (v) => v !== null && Number.isFinite(v);
  const xs = lines.flatMap((l) => l.x).filter(finite), ys = lines.flatMap((l) => l.y).filter(finite);
  if (!xs.length) return el("p", { class: "hint" }, "nothing to draw");
  let [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  if (zero) [y0, y1] = [Math.min(y0, 0), Math.max(y1, 0)];
  if (y1 - y0 < 1e-12) [y0, y1] = [y0 - 0.5, y1 + 0.5];
  if (x1 - x0 < 1e-12) [x0, x1] = [x0 - 0.5, x1 + 0.5];
  const X = (v) => left + ((v - x0) / (x1 - x0)) * (width - left - right);
  const Y = (v) => height - bottom - ((v - y0) / (y1 - y0)) * (height - bottom - top);
  const out = svg("svg", { class: "plot", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
  out.append(svg("path", { class: "axis", d: `M${left} ${top}V${height - bottom}H${width - right}` }));
  const text = (x, y, words, anchor = "middle") => {
    const made = svg("text", { x, y, "text-anchor": anchor });
    made.textContent = words;
    out.append(made);
  };
  for (const v of ticks(x0, x1)) text(X(v), height - bottom + 13, digits(v, 6));
  for (const v of ticks(y0, y1, 3)) text(left - 4, Y(v) + 4, digits(v, 4), "end");
  text((left + width) / 2, height - 3, xLabel);
  text(left + 4, top + 8, yLabel, "start");
  const styles = ["line", "line two", "line three"];
  lines.forEach((l, k) => {
    let d = "", pen = "M";
    l.x.forEach((v, i) => {
      if (!finite(v) || !finite(l.y[i])) { pen = "M"; return; }
      d += `${pen}${X(v).toFixed(1)} ${Y(l.y[i]).toFixed(1)}`;
      pen = "L";
    });
    out.append(svg("path", { class: styles[k % 3], d }));
    if (l.name) text(width - right - 4, top + 10 + 13 * k, l.name, "end"), out.lastChild.setAttribute("class", ["name", "name two", "name three"][k % 3]);
  });
  for (const m of marks) if (finite(m.x) && m.x >= x0 && m.x <= x1) out.append(svg("path", { class: `axis mark-${m.name}`, d: `M${X(m.x)} ${top}V${height - bottom}` }));
  return out;
}

function ticks(low, high, count = 5) {
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((f) => f * power).find((s) => s >= raw);
  const found = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) found.push(Math.abs(v) < 1e-9 * step ? 0 : v);
  return found;
}

export function profiles(picture, found, codes) {
  const at = found?.true_px ?? [picture.col0 + picture.cols / 2, picture.row0 + picture.rows / 2];
  const row = Math.min(Math.max(Math.round(at[1]) - picture.row0, 0), picture.rows - 1);
  const col = Math.min(Math.max(Math.round(at[0]) - picture.col0, 0), picture.cols - 1);
  const across = Array.from({ length: picture.cols }, (_, k) => codes[row * picture.cols + k]);
  const down = Array.from({ length: picture.rows }, (_, k) => codes[k * picture.cols + col]);
  const reach = 24;
  const one = (values, first, middle, axis) => {
    const from = Math.max(Math.round(middle) - first - reach, 0), to = Math.min(from + 2 * reach + 1, values.length);
    const k = axis === "x" ? 0 : 1;
    const marks = [{ x: at[k], name: "true" }];
    if (found?.found_px) marks.push({ x: found.found_px[k], name: "found" });
    const x = [], y = [];
    values.slice(from, to).forEach((v, i) => { x.push(first + from + i - 0.5, first + from + i + 0.5); y.push(v, v); });
    return plot({ lines: [{ x, y }], marks, xLabel: `${axis} / px`, yLabel: "DN", label: `Profile along ${axis} through the target`, height: 120 });
  };
  return [one(across, picture.col0, at[0], "x"), one(down, picture.row0, at[1], "y")];
}
