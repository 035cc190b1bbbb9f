// The pictures that show a find or any place, best first, with the place marked in each; the one looked at is outlined on
// the map. The box is not modal: commands stay in reach.

import { get, picture } from "/static/core/api.js";
import { button, make, setText } from "/static/core/dom.js";
import { state } from "/static/core/store.js";
import { text } from "/static/core/values.js";
import { t } from "/static/core/strings.js";
import { feature, show as draw } from "/static/map/map.js";

const MOST = 12;

export function picturesDialog() {
  const title = make("h2", { id: "find-pictures" });
  const list = make("ul", { class: "pictures" });
  const close = button("×", () => box.close(), { class: "close", "aria-label": t("finds.pictures.close") });
  const box = make("dialog", { onclose: () => outline(null), class: "find-pictures", "aria-labelledby": "find-pictures", onkeydown: (event) => { if (event.key === "Escape") box.close(); } }, make("div", { class: "row" }, title, close), list);
  const say = (words) => list.replaceChildren(make("li", { class: "quiet" }, words));
  async function show(find) {
    setText(title, find.id == null ? t("finds.pictures.here") : t("finds.pictures.of", { note: text(find.note) || t("finds.unnamed") }));
    outline(null);
    say("…");
    if (!box.open) box.show();
    close.focus();
    try {
      const place = new URLSearchParams({ lat_deg: find.lat_deg, lon_deg: find.lon_deg });
      const rows = (await get(find.id == null ? `/api/pictures?${place}` : `/api/finds/${encodeURIComponent(find.id)}/pictures`)).filter((row) => row.seq != null);
      if (rows.length) list.replaceChildren(...rows.slice(0, MOST).map(figure));
      else say(t("finds.pictures.none"));
    } catch (error) {
      say(error.message);
    }
  }
  return { box, show };
}

const outline = (row) => draw("sighting", row?.outline?.length > 2 ? [feature("LineString", [...row.outline, row.outline[0]])] : []);

// A press shows it as wide as the box, with the place marked, and small again.
function figure(row) {
  const name = t("finds.pictures.one", { image: text(row.image), name: state.vehicles.get(row.vehicle)?.name ?? text(row.vehicle) });
  const image = make("img", { alt: name });
  const mark = make("i", {});
  image.addEventListener("load", () => { mark.style.left = `${(100 * row.column) / image.naturalWidth}%`; mark.style.top = `${(100 * row.row) / image.naturalHeight}%`; URL.revokeObjectURL(image.src); });
  const larger = make("button", { type: "button", "aria-pressed": "false", "aria-label": name, onclick: () => larger.setAttribute("aria-pressed", String(larger.getAttribute("aria-pressed") === "false")) }, image, mark);
  for (const looked of ["pointerenter", "focus", "click"]) larger.addEventListener(looked, () => outline(row));
  const item = make("li", {}, make("figure", {}, larger, make("figcaption", {}, name)));
  picture(`/api/frames/${row.seq}/view`).then((url) => { image.src = url; }, (error) => { item.textContent = `${name}: ${error.message}`; });
  return item;
}
