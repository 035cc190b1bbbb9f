// Where pictures show a surveyed point: each picture around the place where it should be, to be pressed where it is.

import { get, picture, post } from "/static/core/api.js";
import { button, make, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state } from "/static/core/store.js";
import { text } from "/static/core/values.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";

const MOST = 12;
const FIELDS_PX = [40, 80, 160, 320, 640]; // pixels of a picture that are shown across
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const STEP = 1 / 200; // of what is shown across, about a pixel of the screen
const SAVED_MS = 500; // after the last press of an arrow

export function pointDialog(take, about) {
  const title = make("h2", { id: "point-pictures" });
  const words = make("p", { role: "status" });
  const list = make("ul", { class: "pictures" });
  const close = button("×", () => box.close(), { class: "close", "aria-label": t("finds.pictures.close") });
  let field = 2;
  let figures = [];
  let name = "";
  const zoom = (by) => { field = Math.min(Math.max(field + by, 0), FIELDS_PX.length - 1); figures.forEach((one) => one.draw()); };
  const box = make("dialog", { class: "find-pictures", "aria-labelledby": "point-pictures", onkeydown: (event) => { if (event.key === "Escape") box.close(); } },
    make("div", { class: "row" }, title, close), make("p", { class: "quiet" }, t("points.how")),
    make("div", { class: "row" }, button(t("points.nearer"), () => zoom(-1)), button(t("points.wider"), () => zoom(1))), words, list);
  const point = () => state.points.find((row) => row.name === name);
  const refresh = () => { const row = point(); setText(words, row ? [about(row), ...row.findings].join("; ") : ""); figures.forEach((one) => one.draw()); };

  async function save(seq, column, row) {
    try {
      take(await post("/api/points/marks", { name, seq, column, row }));
    } catch (error) {
      notice("bad", t("points.unsaved", { why: error.message }));
    }
    refresh();
  }

  // A picture with its mark; what is shown stays where the point should be, so that it does not jump under the finger.
  function figure(row) {
    const caption = make("figcaption", {});
    const label = t("finds.pictures.one", { image: text(row.image), name: state.vehicles.get(row.vehicle)?.name ?? text(row.vehicle) });
    const image = make("img", { alt: "", draggable: "false" });
    const sign = make("i", {});
    const off = button(t("points.unmark"), () => save(row.seq, null, null), { class: "small", "aria-label": t("points.unmark.in", { image: label }) });
    let draft = null;
    let timer = null;
    const mark = () => point()?.marks.find((one) => one.seq === row.seq);
    function set(at, soon) {
      draft = at;
      draw();
      clearTimeout(timer);
      timer = setTimeout(async () => { await save(row.seq, at[0], at[1]); if (draft === at) { draft = null; draw(); } }, soon);
    }
    const area = make("button", { type: "button", class: "crop", "aria-label": t("points.in", { image: label }), onclick: (event) => {
      const across = FIELDS_PX[field];
      const bounds = area.getBoundingClientRect();
      if (!event.detail) set(draft ?? [mark()?.column ?? row.column, mark()?.row ?? row.row], 0); // by the keyboard
      else set([row.column + ((event.clientX - bounds.left) / bounds.width - 0.5) * across, row.row + ((event.clientY - bounds.top) / bounds.height - 0.5) * across], 0);
    }, onkeydown: (event) => {
      const step = STEPS[event.key];
      if (!step) return;
      event.preventDefault();
      const at = draft ?? [mark()?.column ?? row.column, mark()?.row ?? row.row];
      set([at[0] + step[0] * FIELDS_PX[field] * STEP, at[1] + step[1] * FIELDS_PX[field] * STEP], SAVED_MS);
    } }, image, sign);
    function draw() {
      const across = FIELDS_PX[field];
      const known = mark();
      const at = draft ?? (known ? [known.column, known.row] : null);
      const percent = (pixel, middle) => `${50 + (100 * (pixel - middle)) / across}%`;
      Object.assign(image.style, { width: `${(100 * image.naturalWidth) / across}%`, left: percent(-0.5, row.column), top: percent(-0.5, row.row) });
      Object.assign(sign.style, { left: percent(at?.[0] ?? row.column, row.column), top: percent(at?.[1] ?? row.row, row.row) });
      area.dataset.marked = String(Boolean(at));
      setHidden(off, !known);
      setText(caption, known ? (known.off_px == null ? t("points.marked", { image: label }) : t("points.marked.off", { image: label, px: units.fixed(known.off_px, 1) })) : label);
    }
    image.addEventListener("load", () => { draw(); URL.revokeObjectURL(image.src); });
    picture(`/api/frames/${row.seq}/view`).then((url) => { image.src = url; }, (error) => setText(caption, `${label}: ${error.message}`));
    return { line: make("li", {}, make("figure", {}, area, caption), off), draw };
  }

  async function show(wanted) {
    name = wanted;
    figures = [];
    setText(title, t("points.of", { name }));
    list.replaceChildren(make("li", { class: "quiet" }, "…"));
    if (!box.open) box.show();
    close.focus();
    try {
      const rows = (await get(`/api/points/pictures?name=${encodeURIComponent(name)}`)).filter((row) => row.seq != null);
      figures = rows.slice(0, MOST).map(figure);
      list.replaceChildren(...(rows.length ? figures.map((one) => one.line) : [make("li", { class: "quiet" }, t("finds.pictures.none"))]));
    } catch (error) {
      list.replaceChildren(make("li", { class: "quiet" }, error.message));
    }
    refresh();
  }
  return { box, show };
}
