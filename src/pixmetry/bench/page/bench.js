// The bench: one state, what the server makes of it, and what shows it.
import { $, digits, el, mpx, packed, px, rms, unpacked } from "./dom.js";
import { Follow, Latest } from "./ask.js";
import { drawFound, errorText, paint, profiles, screen } from "./draw.js";
import { control } from "./controls.js";
import { makeViews, refresh, show as showView } from "./views.js";
import { takeAway } from "./away.js";
import { once } from "./ask.js";

const REST_MS = 160; // without a move, before the slow things are asked for
const LEAST_SHARE = 1e-4; // of the error, from which on a source that the camera is not described with is shown in the chain
const CALM_SHARE = 0.15; // of the error, from which on a source stands out

const bench = { catalogue: null, state: {}, camera: null, picture: null, codes: null, found: null, rows: new Map(), budget: null, together: null, stale: false, before: false };
window.bench = bench; // for tests and for the curious
let answered = 0;
bench.answers = () => answered; // pictures and refusals so far
bench.busy = () => pictures.busy;

const said = (text) => { $("said").textContent = text ?? ""; };

// ---- asking ------------------------------------------------------------------------------------------------------------------

const failed = (text) => { said(text); answered++; };
const pictures = new Latest("picture", showPicture, failed);
const foundIn = new Latest("found", showFound, failed);
const cameras = new Latest("camera", showCamera, failed);
const budgets = new Follow("budget", showLine, failed);
let resting = 0;

function changed(redraw = false) {
  history.replaceState(null, "", `#${packed(bench.state)}`);
  said("");
  bench.asked = performance.now();
  pictures.ask(bench.state);
  bench.stale = true;
  budgets.stop();
  clearTimeout(resting);
  resting = setTimeout(rest, REST_MS);
  if (redraw) cameras.ask(bench.state);
}

function rest() {
  foundIn.ask(bench.state);
  refresh();
  cameras.ask(bench.state);
  bench.rows = new Map();
  bench.together = null;
  budgets.ask(bench.state);
  if (bench.other) askOther();
}

// ---- the picture -------------------------------------------------------------------------------------------------------------

let shown = null;

function showPicture(answer) {
  bench.picture = answer.picture;
  const stale = bench.found ? { true_px: answer.true_px, found_px: null } : { true_px: answer.true_px };
  if (!shown || shown.cols !== answer.picture.cols || shown.rows !== answer.picture.rows) {
    const made = screen(answer.picture, "The target");
    const caption = el("figcaption", {}, el("b", {}, "as it is"), " ", el("span"));
    const figure = el("figure", { id: "as-it-is" }, made.box, caption);
    shown = { ...made, cols: answer.picture.cols, rows: answer.picture.rows, text: caption.lastChild };
    $("pictures").replaceChildren(figure);
  }
  bench.codes = paint(shown.canvas, answer.picture);
  drawFound(shown.over, answer.picture, { ...stale });
  $("profiles").replaceChildren(...profiles(answer.picture, { true_px: answer.true_px }, bench.codes));
  bench.drawn = performance.now();
  answered++;
  document.body.dataset.drawn = String(Number(document.body.dataset.drawn ?? 0) + 1);
}

function showFound(answer) {
  bench.found = answer.found;
  if (!shown || !bench.picture) return;
  drawFound(shown.over, bench.picture, answer.found);
  shown.text.textContent = errorText(answer.found);
  shown.canvas.setAttribute("aria-label", `The target as the camera stores it; ${errorText(answer.found)}`);
  $("profiles").replaceChildren(...profiles(bench.picture, answer.found, bench.codes));
  document.getElementById("beside")?.remove();
  if (answer.beside) {
    const made = screen(answer.beside, `The target without the chosen source; ${errorText(answer.beside_found)}`);
    drawFound(made.over, answer.beside, answer.beside_found);
    const title = bench.catalogue.sources[sourceOf(bench.state.chosen)]?.title ?? "the chosen source";
    $("pictures").append(el("figure", { id: "beside" }, made.box, el("figcaption", {}, el("b", {}, `without: ${title.toLowerCase()}`), " ", errorText(answer.beside_found))));
  }
  document.body.dataset.found = String(Number(document.body.dataset.found ?? 0) + 1);
}

// ---- the camera and its chain --------------------------------------------------------------------------------------------------

const sourceOf = (name) => bench.camera?.chain.find((e) => e.name === name)?.source ?? name;

function showCamera(camera) {
  const first = bench.camera === null || bench.camera.name !== camera.name || bench.camera.chain.length !== camera.chain.length;
  bench.camera = camera;
  showChain();
  if (first || bench.panel !== panelMark()) showSource();
  if (first || bench.redrawScenario) showScenario();
  bench.redrawScenario = false;
}

const panelMark = () => `${bench.state.chosen}|${bench.camera.chain.find((e) => e.name === bench.state.chosen)?.on}|${bench.camera.name}|${bench.camera.chain.length}`;

function share(row) {
  if (!row) return 0;
  if (!bench.before) return row.share || 0;
  const whole = [...bench.rows.values()].filter((r) => counted(r)).reduce((s, r) => s + r.before_px ** 2, 0);
  return whole && counted(row) ? row.before_px ** 2 / whole : 0;
}

const counted = (row) => ["measured", "from the sheet", "described", "typical"].includes(row.status);

function chip(name, title, on, changedHere, row) {
  const part = share(row);
  const bar = el("i", { "aria-hidden": "true" });
  bar.style.width = `${(100 * Math.sqrt(part)).toFixed(1)}%`;
  const size = row && (bench.before ? row.before_px : row.after_px);
  const button = el(
    "button",
    {
      type: "button", class: `chip${part > CALM_SHARE ? " large" : ""}${on ? "" : " off"}${changedHere ? " changed" : ""}`, "data-source": name,
      "aria-pressed": String(bench.state.chosen === name), onclick: () => choose(name),
      "aria-label": `${title}${on ? "" : ", switched off"}${part ? `, ${digits(100 * part, 2)} % of the error` : ""}`,
    },
    bar, el("span", {}, title), el("b", {}, on && size > 5e-6 ? mpx(size).replace(" mpx", "") : ""),
  );
  return el("li", {}, button);
}

function showChain() {
  const { catalogue, camera } = bench;
  const focus = document.activeElement?.dataset?.source;
  const rows = new Map([...bench.rows.values()].map((r) => [r.name, r]));
  const stages = catalogue.stages.map((stage) => {
    const there = camera.chain.filter((e) => catalogue.sources[e.source].stage === stage.id).map((e) => [e.name, e]);
    const more = [...rows.values()].filter((r) => !camera.chain.some((e) => e.source === r.source_id) && counted(r) && share(r) > LEAST_SHARE && catalogue.sources[r.source_id]?.stage === stage.id);
    const whole = [...there.map(([n]) => rows.get(n)), ...more].reduce((s, r) => s + share(r), 0);
    const items = there.map(([n, e]) => chip(n, catalogue.sources[e.source].title, e.on, e.changed.length > 0, rows.get(n)));
    items.push(...more.map((r) => chip(r.name, `${r.title} (typical)`, true, false, r)));
    const head = el("li", { "data-stage": stage.id, class: items.length > 12 ? "long" : "" }, el("div", { class: "stage" }, el("span", {}, stage.title), el("span", {}, whole >= 0.0005 ? `${digits(100 * whole, 2)} %` : "")), el("ul", {}, items));
    head.style.borderTopColor = whole > 0 ? `color-mix(in srgb, var(--hot) ${Math.round(100 * Math.sqrt(whole))}%, var(--grid))` : "";
    return head;
  });
  $("chain").replaceChildren(...stages);
  const absent = Object.values(catalogue.sources).filter((s) => !camera.chain.some((e) => e.source === s.id));
  $("absent-list").replaceChildren(...absent.map((s) => chip(s.id, s.title, true, false, rows.get(s.id))));
  if (focus) document.querySelector(`#chain [data-source="${CSS.escape(focus)}"]`)?.focus();
}

function choose(name) {
  bench.state.chosen = name;
  history.replaceState(null, "", `#${packed(bench.state)}`);
  showChain();
  showSource();
  showBars();
  foundIn.ask(bench.state);
}

// ---- the source that is looked at ----------------------------------------------------------------------------------------------

function showSource() {
  const name = bench.state.chosen, element = bench.camera.chain.find((e) => e.name === name), source = bench.catalogue.sources[element?.source ?? name];
  bench.panel = panelMark();
  const body = $("source-body");
  if (!source) {
    $("source-title").textContent = "Source";
    body.replaceChildren(el("p", { class: "hint" }, "Choose a source in the chain: its equation, its parameters and what it does appear here."));
    return;
  }
  $("source-title").textContent = source.title;
  const parts = [];
  const stars = "★".repeat(source.stars) + "☆".repeat(5 - source.stars);
  parts.push(el("p", { class: "hint" }, el("span", { class: "stars", role: "img", "aria-label": `${source.stars} of 5 stars in the handbook` }, source.number ? stars : ""), ` ${source.number ? `row ${source.number} of the handbook's table` : "not in the handbook's table"}${source.note ? `, ${source.note}` : ""} · ${source.id}`));
  parts.push(el("p", { class: "about" }, source.description));
  if (source.equation) parts.push(el("p", { class: "equation" }, source.equation));
  const row = el("div", { class: "row" });
  if (element) {
    const box = el("input", { type: "checkbox", id: "on", checked: element.on, disabled: element.essential, onchange: () => turn(name, box.checked) });
    row.append(el("span", { class: "switch" }, box, el("label", { for: "on" }, element.essential ? "on (no frame is made without it)" : "on")));
    row.append(el("button", { type: "button", onclick: () => setAll(name, source, "typical") }, "typical"), el("button", { type: "button", onclick: () => setAll(name, source, "bound") }, "at the bound"));
    if (element.changed.length) row.append(el("button", { type: "button", onclick: () => undo(name) }, "undo"));
    if (element.added) row.append(el("button", { type: "button", onclick: () => remove(name) }, "take out"));
  } else if (source.in_frames) {
    row.append(el("button", { type: "button", id: "add", onclick: () => add(source) }, "Put it into this camera"));
  } else {
    row.append(el("span", { class: "hint" }, source.reasons.forward ?? ""));
  }
  parts.push(row);
  for (const c of source.controls) {
    if (!element) continue;
    const key = `${name}.${c.name}`;
    const made = control({ ...c, value: element.values[c.name] }, (v) => set(key, v, made.box), { key });
    made.box.classList.toggle("changed", element.changed.includes(c.name));
    parts.push(made.box);
  }
  parts.push(el("p", { class: "about" }, el("b", {}, "Usual size: "), source.typical_size), el("p", { class: "about" }, el("b", {}, "What to do: "), source.advice));
  parts.push(el("details", {}, el("summary", {}, "References"), el("ul", {}, source.references.map((r) => el("li", { class: "about" }, r)))));
  body.replaceChildren(...parts);
}

function set(key, value, box) {
  bench.state.set = { ...bench.state.set, [key]: value };
  box?.classList.add("changed");
  changed();
}

function setAll(name, source, which) {
  const values = { ...bench.state.set };
  for (const c of source.controls) if (c.kind !== "fixed") values[`${name}.${c.name}`] = c[which];
  bench.state.set = values;
  bench.panel = null;
  changed(true);
}

function undo(name) {
  bench.state.set = Object.fromEntries(Object.entries(bench.state.set).filter(([k]) => k.slice(0, k.lastIndexOf(".")) !== name));
  bench.panel = null;
  changed(true);
}

function turn(name, on) {
  const without = (list) => (list ?? []).filter((n) => n !== name);
  const start = !(bench.state.off ?? []).includes(name) && !(bench.state.on ?? []).includes(name);
  bench.state.off = without(bench.state.off);
  bench.state.on = without(bench.state.on);
  if (start && !on) bench.state.off.push(name);
  if (start && on) bench.state.on.push(name);
  changed(true);
}

function add(source) {
  bench.state.add = [...(bench.state.add ?? []), source.id];
  const values = { ...bench.state.set };
  const ofTheCamera = ["bits", "reference_dn", "pitch_um", "pitch_x_um", "pitch_y_um"]; // the server knows these of its other sources
  for (const c of source.controls) if (c.kind !== "fixed" && !ofTheCamera.includes(c.name)) values[`${source.id}.${c.name}`] = c.typical;
  bench.state.set = values;
  bench.state.chosen = source.id;
  bench.panel = null;
  changed(true);
}

function remove(name) {
  bench.state.add = bench.state.add.filter((n) => n !== name);
  undo(name);
}

// ---- scenario ------------------------------------------------------------------------------------------------------------------

const PARTS = { target: "Target", light: "Light", motion: "Motion", state: "Warm-up", count: "Frames, targets, rays", calibration: "Calibration", storage: "Storage", object: "Object and lens", goal: "What is wanted" };

function showScenario() {
  const { catalogue, camera } = bench;
  const boxes = Object.entries(catalogue.scenario).map(([part, controls]) => {
    const made = controls.map((c) => {
      const value = camera.scenario[`${part}.${c.name}`];
      return control({ ...c, value, unit: unitOf(c.name) }, (v) => setScenario(part, c.name, v), { title: plainName(c.name), key: `${part}.${c.name}` }).box;
    });
    if (part === "target") made.push(...placeControls());
    return el("details", { open: part === "target" }, el("summary", {}, PARTS[part] ?? part), made);
  });
  const own = catalogue.own.map((c) => control({ ...c, value: camera.own[c.name] }, (v) => set(c.name, v), { title: plainName(c.name), key: c.name }).box);
  const seed = control({ name: "seed", kind: "int", low: 0, high: 1000, unit: "", text: "of the noise of this frame", value: bench.state.seed ?? 0 }, (v) => { bench.state.seed = v; changed(); }).box;
  boxes.push(el("details", {}, el("summary", {}, "Exposure, temperature, unit"), own, seed));
  const open = new Set([...document.querySelectorAll("#scenario details")].filter((d) => d.open).map((d) => d.firstChild.textContent));
  $("scenario").replaceChildren(...boxes);
  for (const d of $("scenario").children) if (open.has(d.firstChild.textContent)) d.open = true;
}

function placeControls() {
  const { cols, rows, place_px: at } = bench.camera;
  return [["x_px", cols - 1, at[0]], ["y_px", rows - 1, at[1]]].map(([name, high, value]) =>
    control({ name, kind: "float", low: 0, high, unit: "px", text: "place in the scene", value }, (v) => { bench.state[name] = v; changed(); }, { title: plainName(name), key: name }).box);
}

const UNITS = { px: "px", mm: "mm", s: "s", hz: "Hz", nm: "nm", deg: "°", min: "min", k: "K", s2: "s²" };
function unitOf(name) {
  const [, top, below] = /_(px|mm|s|hz|nm|deg|min|k)(?:_per_(px|s2|s))?$/.exec(name) ?? [];
  return top ? UNITS[top] + (below ? `/${UNITS[below]}` : "") : "";
}
const plainName = (name) => name.replace(/_(px|mm|s|hz|nm|deg|min|k|rel|c)(_per_(px|s2|s))?$/, "").replaceAll("_", " ");

function setScenario(part, name, value) {
  const own = { ...(bench.state.scenario?.[part] ?? {}) };
  if (value === null) delete own[name];
  else own[name] = value;
  bench.state.scenario = { ...bench.state.scenario, [part]: own };
  changed();
}

// ---- numbers -------------------------------------------------------------------------------------------------------------------

let drawing = 0;

function showLine(line) {
  if (line.kind === "error") { said(line.text); $("settling").textContent = ""; return; }
  if (line.error || line.overtaken) { if (line.error) said(line.error); return; }
  if (line.kind === "begin") bench.of = line.rows;
  if (line.kind === "row") bench.rows.set(line.row.name, line.row);
  if (line.kind === "budget") {
    bench.budget = line.budget;
    bench.rows = new Map(line.budget.rows.map((r) => [r.name, r]));
    bench.stale = false;
    if (bench.other) showOther();
    document.body.dataset.budget = String(Number(document.body.dataset.budget ?? 0) + 1);
  }
  if (line.kind === "together") bench.together = line;
  if (!drawing) drawing = requestAnimationFrame(() => { drawing = 0; showNumbers(); });
}

function showNumbers() {
  if (!bench.camera) return;
  showChain();
  showBars();
  showHeadline();
}

function showHeadline() {
  const box = $("headline"), b = bench.budget;
  box.classList.toggle("stale", bench.stale);
  const count = bench.rows.size, state = bench.stale ? `${count} of ${bench.of ?? "…"} sources computed` : bench.together ? simulated() : "simulating all sources at once …";
  $("settling").textContent = state;
  if (!b) return;
  const one = b.one_target_one_frame, pair = bench.before ? one.before_px : one.after_px;
  const parts = [el("div", { class: "big" }, ...["x", "y"].map((axis, k) => el("span", {}, el("i", {}, axis), px(pair[k]))))];
  parts.push(el("p", {}, bench.before ? "one target in one frame, without a calibration (k = 1)" : "one target in one frame, after calibration (k = 1)"));
  parts.push(el("p", {}, `rms of x and y after calibration ${px(rms(one.after_px))}: between ${px(rms(one.least_px))} (only what is known) and ${px(rms(one.most_px))} (the rest at its bound)`));
  if (one.after_mm) parts.push(el("p", {}, `on the object: ${digits(one.after_mm[0], 2)} mm × ${digits(one.after_mm[1], 2)} mm`));
  const m = b.answer;
  if (m.frames > 1 || m.targets > 1) parts.push(el("p", {}, `mean over ${m.frames} frames and ${m.targets} targets: x ${px(m.after_px[0])}, y ${px(m.after_px[1])}`));
  if (b.goal_text) parts.push(el("p", {}, b.goal_text));
  const next = b.to_change.find((s) => s.worth);
  if (next) parts.push(el("p", {}, el("b", {}, "Change first: "), `${next.title}; without it ${px(next.then_px)} in place of ${px(next.now_px)}`));
  box.replaceChildren(...parts);
}

function simulated() {
  const t = bench.together.together;
  return `all sources of the chain at once, simulated in ${t.trials} windows: ${digits(t.total_px, 3)} ± ${digits(t.se_total_px, 1)} px, after a calibration ${digits(t.calibrated_px, 3)} ± ${digits(t.se_calibrated_px, 1)} px${bench.together.last ? "" : " …"}`;
}

function showBars() {
  const size = (r) => (bench.before ? r.before_px : r.after_px) || 0;
  const rows = [...bench.rows.values()].filter((r) => counted(r) && size(r) > 1e-6).sort((a, b) => size(b) - size(a)).slice(0, 24);
  const most = Math.max(...rows.map(size), 1e-12);
  $("bars").replaceChildren(...rows.map((r) => {
    const parts = bench.before ? r.before : r.after;
    const bar = el("span", { class: "bar", "aria-hidden": "true" });
    const squares = ["constant", "smooth", "place", "time"].map((n) => [n, (parts[`${n}_px`][0] ** 2 + parts[`${n}_px`][1] ** 2) / 2]);
    const whole = squares.reduce((s, [, v]) => s + v, 0) || 1;
    for (const [n, v] of squares) {
      const piece = el("i", { class: n });
      piece.style.width = `${((100 * size(r)) / most) * (v / whole)}%`;
      bar.append(piece);
    }
    const words = squares.filter(([, v]) => v > 0.01 * whole).map(([n]) => n).join(", ");
    return el("li", {}, el("button", { type: "button", "data-source": r.name, "aria-pressed": String(bench.state.chosen === r.name), title: `${r.status}; ${r.how}${r.reason ? `; ${r.reason}` : ""}`, "aria-label": `${r.title}: ${mpx(size(r))}, ${words}`, onclick: () => choose(r.name) }, el("span", {}, r.title), bar, el("em", {}, mpx(size(r)))));
  }));
}

// ---- begin ---------------------------------------------------------------------------------------------------------------------

function fillChoices() {
  const { catalogue, cameras: names } = bench;
  const group = (label, list) => el("optgroup", { label }, list.map((n) => el("option", { value: n }, n)));
  const given = names.filter((n) => n === "given");
  $("camera").replaceChildren(...(given.length ? [group("Of the command line", given)] : []), group("Presets", catalogue.presets), group("Data sheets", catalogue.sheets), el("optgroup", { label: "File" }, el("option", { value: "file", disabled: true }, "an opened file")));
  $("note").append(...catalogue.notes.map((n) => el("option", { value: n.number }, `${n.number} ${n.title}`)));
  $("estimator").replaceChildren(...catalogue.estimators.map((n) => el("option", { value: n }, n.replaceAll("_", " "))));
}

function showState() {
  $("camera").value = bench.state.record ? "file" : bench.state.camera;
  $("estimator").value = bench.state.estimator ?? "auto";
  $("side").value = bench.state.side_px ?? 128;
  bench.camera = null;
  bench.budget = null;
  bench.rows = new Map();
  $("headline").replaceChildren(el("p", {}, "The budget is being computed; its rows appear below as they are known."));
  changed(true);
}

export function begin(state) {
  bench.state = { camera: bench.first, set: {}, scenario: {}, chosen: "", ...state };
  bench.panel = null;
  showState();
}

function showLesson(note) {
  const box = $("lesson");
  box.hidden = !note;
  $("note").value = note?.number ?? "";
  if (note) box.replaceChildren(el("p", {}, el("b", {}, `Note ${note.number}: ${note.title}. `), note.text));
}

$("note").addEventListener("change", () => {
  const note = bench.catalogue.notes.find((n) => String(n.number) === $("note").value);
  showLesson(note);
  if (!note) return;
  begin(structuredClone(note.state));
  showView(note.view);
});
$("open").addEventListener("click", () => $("file").click());
$("file").addEventListener("change", async () => {
  const [file] = $("file").files;
  $("file").value = "";
  if (!file) return;
  try {
    if (file.size > 400000) throw new Error("the file is too large for a camera file");
    const { record } = await once("read", { text: await file.text() });
    begin({ record, scenario: bench.state.scenario, estimator: bench.state.estimator });
  } catch (problem) {
    said(`${file.name}: ${problem.message}`);
  }
});
$("take").addEventListener("click", () => takeAway(bench));

// ---- two cameras side by side --------------------------------------------------------------------------------------------------

const otherFound = new Latest("found", (answer) => { bench.other.found = answer.found; showOther(); }, failed, "-beside");
const otherPicture = new Latest("picture", (answer) => { bench.other.picture = answer.picture; showOther(); }, failed, "-beside");
const otherBudget = new Follow("budget", (line) => {
  if (!bench.other) return;
  if (line.kind === "budget") bench.other.budget = line.budget;
  if (line.kind === "row") bench.other.count = (bench.other.count ?? 0) + 1;
  showOther();
}, failed, "-beside");

let askingOther = null;

function askOther() {
  clearTimeout(askingOther);
  if (!bench.budget || bench.stale) { askingOther = setTimeout(() => { if (bench.other) askOther(); }, 500); return; }
  if (bench.other.budget) return;
  bench.other.count = 0;
  otherBudget.ask(bench.other.state);
}

$("compare").addEventListener("click", () => {
  if (bench.other) {
    bench.other = null;
    otherBudget.stop();
    $("other").hidden = true;
  } else {
    bench.other = { state: structuredClone(bench.state), name: bench.camera?.name };
    otherPicture.ask(bench.other.state);
    otherFound.ask(bench.other.state);
    if (bench.budget && !bench.stale) bench.other.budget = bench.budget;
    askOther();
    showOther();
  }
  $("compare").setAttribute("aria-pressed", String(Boolean(bench.other)));
  $("compare").textContent = bench.other ? "End comparing" : "Compare";
});

function showOther() {
  const box = $("other"), o = bench.other;
  if (!o) return;
  box.hidden = false;
  const parts = [el("h2", {}, `Beside it: ${o.name}`), el("p", { class: "hint" }, "This one stays as it was. Change the camera, a parameter or the estimator above, and compare.")];
  const choice = el("select", { "aria-label": "The camera beside", onchange: () => { o.state = { camera: choice.value, set: {}, scenario: structuredClone(bench.state.scenario ?? {}), estimator: bench.state.estimator, chosen: "" }; o.name = choice.value; o.budget = null; otherPicture.ask(o.state); otherFound.ask(o.state); askOther(); } });
  choice.append(el("option", { value: "" }, "another camera…"), ...bench.cameras.map((n) => el("option", { value: n }, n)));
  parts.push(el("div", { class: "row" }, choice, el("button", { type: "button", onclick: () => { const mine = bench.state; const theirs = o.state; o.budget = null; o.state = structuredClone(mine); o.name = bench.camera.name; begin(theirs); otherPicture.ask(o.state); otherFound.ask(o.state); askOther(); } }, "Swap the two")));
  const side = el("div", { class: "side" });
  if (o.picture) {
    const made = screen(o.picture, `The target in ${o.name}; ${errorText(o.found)}`);
    drawFound(made.over, o.picture, o.found);
    side.append(el("figure", {}, made.box, el("figcaption", {}, el("b", {}, o.name), " ", errorText(o.found))));
  }
  const table = el("table", {}, el("caption", {}, "One target in one frame, k = 1, rms of x and y"), el("thead", {}, el("tr", {}, ["", bench.camera?.name ?? "", o.name].map((t) => el("th", { scope: "col" }, t)))));
  const body = el("tbody"), mine = bench.stale ? null : bench.budget?.one_target_one_frame, theirs = o.budget?.one_target_one_frame;
  for (const [title, key] of [["before calibration", "before_px"], ["after calibration", "after_px"], ["only what is known", "least_px"], ["the rest at its bound", "most_px"]]) {
    body.append(el("tr", {}, el("th", { scope: "row" }, title), ...[mine, theirs].map((one) => el("td", { class: "n" }, one ? px(rms(one[key])) : "…"))));
  }
  if (!theirs) parts.push(el("p", { class: "hint" }, `The budget of ${o.name} follows that of the camera above: ${o.count ?? 0} sources so far.`));
  if (mine && theirs) {
    const rows = new Map();
    for (const [k, b] of [[0, bench.budget], [1, o.budget]]) for (const r of b.rows) if (counted(r)) (rows.get(r.source_id) ?? rows.set(r.source_id, { title: r.title, px: [0, 0] }).get(r.source_id)).px[k] = Math.hypot((rows.get(r.source_id)?.px[k]) ?? 0, r.after_px);
    const apart = [...rows.values()].sort((a, b) => Math.abs(b.px[0] ** 2 - b.px[1] ** 2) - Math.abs(a.px[0] ** 2 - a.px[1] ** 2)).slice(0, 8);
    body.append(el("tr", {}, el("th", { scope: "row", colspan: 3 }, "The sources that make the difference, after calibration")));
    for (const r of apart) if (r.px[0] !== r.px[1]) body.append(el("tr", {}, el("th", { scope: "row" }, r.title), ...r.px.map((v) => el("td", { class: "n" }, mpx(v)))));
    const [a, b] = [rms(mine.after_px), rms(theirs.after_px)];
    const better = Math.abs(a - b) < 0.01 * Math.max(a, b) ? "Both are alike." : `${a < b ? bench.camera.name : o.name} is better here: ${px(Math.min(a, b))} against ${px(Math.max(a, b))}.`;
    parts.push(el("p", {}, el("b", {}, better)));
  }
  table.append(body);
  side.append(el("div", { class: "scroll" }, table));
  box.replaceChildren(...parts, side);
}

$("camera").addEventListener("change", () => begin({ camera: $("camera").value, scenario: bench.state.scenario, estimator: bench.state.estimator, chosen: bench.state.chosen }));
$("estimator").addEventListener("change", () => { bench.state.estimator = $("estimator").value; changed(); });
$("reset").addEventListener("click", () => { bench.state = { camera: bench.state.camera, record: bench.state.record, chosen: bench.state.chosen, set: {}, scenario: {} }; showState(); });
$("side").addEventListener("change", () => { bench.state.side_px = Number($("side").value); changed(); });
for (const which of ["before", "after"]) $(which).addEventListener("click", () => {
  bench.before = which === "before";
  for (const id of ["before", "after"]) $(id).setAttribute("aria-pressed", String(id === which));
  showNumbers();
});
window.addEventListener("hashchange", () => { try { begin(unpacked(location.hash.slice(1))); } catch { said("the link does not hold a state"); } });

const opening = await (await fetch("opening")).json();
bench.catalogue = opening.catalogue;
bench.cameras = opening.cameras;
bench.first = opening.state.camera ?? "pulnix_tm6cn_epix_512";
// For tests: open a state and wait for its controls; undo one value.
bench.open = async (state) => {
  begin(state);
  const there = () => bench.camera && bench.panel === panelMark() && !pictures.busy && !cameras.busy;
  while (!there() && !$("said").textContent) await new Promise((done) => setTimeout(done, 10));
};
bench.forget = (key) => { delete bench.state.set[key]; changed(); };

fillChoices();
makeViews(bench, (values) => {
  bench.state.scenario = { ...bench.state.scenario, state: { ...(bench.state.scenario?.state ?? {}), ...values } };
  bench.redrawScenario = true;
  changed();
});
let start = opening.state;
if (location.hash.length > 1) try { start = unpacked(location.hash.slice(1)); } catch { said("the link does not hold a state"); }
begin({ chosen: "grabber.low_pass", ...start });
