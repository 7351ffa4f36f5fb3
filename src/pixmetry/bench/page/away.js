// What is on the page as files and lines, and as a picture.
import { $, el, packed, save } from "./dom.js";
import { once } from "./ask.js";

const ABOUT = {
  "camera.yaml": "the camera with all changes", "pictured.yaml": "the same in the state of the measurement, as it makes the picture", "scene.yaml": "what it looks at",
  "scenario.yaml": "what is measured, and how", "commands.sh": "command lines that make the same again", "again.py": "the same in Python",
};

export async function takeAway(bench) {
  const dialog = $("away");
  const link = `${location.href.split("#")[0]}#${packed(bench.state)}`;
  const close = el("button", { type: "button", onclick: () => dialog.close() }, "Close");
  const copied = el("span", { class: "hint", role: "status" });
  const copy = (text) => navigator.clipboard.writeText(text).then(() => { copied.textContent = "copied"; }, () => { copied.textContent = "select the text and copy it"; });
  const parts = [el("h2", { id: "away-title" }, "Take away"), el("p", { class: "hint" }, "Nothing is written but what you save. The files make the same picture and the same numbers again, to the bit."),
    el("div", { class: "row" }, el("button", { type: "button", id: "copy-link", onclick: () => copy(link) }, "Copy the link"), el("button", { type: "button", onclick: () => savePicture(bench) }, "Save the picture (PNG)"), copied, close)];
  try {
    const files = await once("away", bench.state);
    for (const [name, text] of Object.entries(files)) {
      const area = el("textarea", { readonly: true, spellcheck: "false", "aria-label": name, value: text });
      parts.push(el("h3", {}, name, " ", el("span", { class: "hint" }, ABOUT[name] ?? "")), area, el("div", { class: "row" }, el("button", { type: "button", onclick: () => save(name, text) }, "Save"), el("button", { type: "button", onclick: () => copy(text) }, "Copy")));
    }
  } catch (problem) {
    parts.push(el("p", {}, problem.message));
  }
  dialog.replaceChildren(...parts);
  dialog.showModal();
}

// The pixels four times as large, with what is drawn over them.
async function savePicture(bench) {
  const box = document.querySelector("#as-it-is .screen"), canvas = box.querySelector("canvas");
  const made = el("canvas", { width: 4 * canvas.width, height: 4 * canvas.height }), pen = made.getContext("2d");
  pen.imageSmoothingEnabled = false;
  pen.drawImage(canvas, 0, 0, made.width, made.height);
  const over = box.querySelector("svg").cloneNode(true);
  over.setAttribute("width", made.width);
  over.setAttribute("height", made.height);
  over.setAttribute("xmlns", "http://www.w3.org/2000/svg");
  for (const [name, colour] of [["true", "#39a7ff"], ["found", "#ff8c4a"], ["vector", "#ffd24a"]]) for (const e of over.querySelectorAll(`.${name}`)) e.setAttribute("stroke", colour);
  const image = new Image();
  image.src = URL.createObjectURL(new Blob([new XMLSerializer().serializeToString(over)], { type: "image/svg+xml" }));
  await image.decode();
  pen.drawImage(image, 0, 0, made.width, made.height);
  URL.revokeObjectURL(image.src);
  made.toBlob((blob) => save(`${bench.camera.name}.png`, blob));
}
