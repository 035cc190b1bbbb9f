// Surveyed points: loaded from a table, marked in pictures, and written as gcp_list.txt. The daemon keeps them.

import { get, request, withToken } from "/static/core/api.js";
import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { position, text } from "/static/core/values.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { map, maplibregl } from "/static/map/map.js";
import { pointDialog } from "/static/work/point_marks.js";

const KINDS = ".csv,.txt";
const ENOUGH = 3; // marks of a point: with fewer a wrong one is not found
const markers = new Map();
const take = (rows) => { state.points = rows.filter((row) => position(row.lon_deg, row.lat_deg)); changed("points"); };

export async function loadPoints() {
  try { take(await get("/api/points")); } catch { /* the stream tells when the station is back */ }
}

const lengthOf = (off) => units.error(Math.hypot(off[0], off[1]));

function aboutPoint(row) {
  const parts = [t("points.marks", { n: row.marks.length, of: Math.max(ENOUGH, row.marks.length) })];
  if (row.off_m) parts.push(t("points.off", { m: lengthOf(row.off_m) }));
  if (row.rays_miss_m != null) parts.push(t("points.miss", { m: units.error(row.rays_miss_m) }));
  return parts.join("; ");
}

export function pointPanel() {
  const { box, show } = pointDialog(take, aboutPoint);
  document.body.append(box);
  const file = make("input", { type: "file", accept: KINDS, class: "hidden-file", "aria-label": t("points.load"), onchange: () => { if (file.files[0]) read(file.files[0]); file.value = ""; } });
  async function read(table) {
    try {
      take(await request("PUT", "/api/points", table));
    } catch (error) {
      notice("bad", t("points.refused", { why: error.message }));
    }
  }
  const list = make("ul", { class: "finds" });
  const about = make("p", { class: "quiet" }, t("points.none"));
  const save = make("a", { download: "gcp_list.txt" }, t("points.save"));
  const saved = make("p", { class: "points-file" }, save);
  const draw = keyedList(list, (row) => make("li", {}, button("", () => show(row.name), { class: "find" }), make("small", {})), (line, row) => {
    setText(line.firstChild, text(row.name));
    setText(line.lastChild, [aboutPoint(row), ...row.findings].join("; "));
  });
  subscribe("points ready", "points", () => {
    draw(state.points.map((row) => [row.name, row]));
    setHidden(about, state.points.length > 0);
    setHidden(saved, !state.points.some((row) => row.marks.length));
    setAttribute(save, "href", withToken("/api/points/gcp_list.txt"));
    for (const [name, marker] of markers) if (!state.points.some((row) => row.name === name)) { marker.remove(); markers.delete(name); }
    for (const row of state.points) {
      const marker = markers.get(row.name) ?? new maplibregl.Marker({ element: make("button", { type: "button", class: "find-marker point-marker", onclick: () => show(row.name), "aria-label": t("points.marker", { name: row.name }) }, "△") }).setLngLat([row.lon_deg, row.lat_deg]).addTo(map);
      markers.set(row.name, marker.setLngLat([row.lon_deg, row.lat_deg]));
    }
  });
  return make("section", {}, make("h2", {}, t("points.title")), make("div", { class: "row wrap" }, button(t("points.load"), () => file.click()), file), about, list, saved);
}
