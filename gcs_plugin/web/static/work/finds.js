// Finds: places that somebody marks on the map, with a note and how far off they may be. The daemon keeps them.

import { get, post, request } from "/static/core/api.js";
import { timeOfDay } from "/static/core/clock.js";
import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { settings } from "/static/core/settings.js";
import { changed, state, subscribe } from "/static/core/store.js";
import { positionText } from "/static/core/coordinates.js";
import { position, text } from "/static/core/values.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { circle } from "/static/map/geodesy.js";
import { sigmaAt } from "/static/map/legs.js";
import { feature, map, maplibregl, show } from "/static/map/map.js";
import { dropTool, takeTool, tool } from "/static/map/tools.js";
import { picturesDialog } from "/static/work/find_pictures.js";

const markers = new Map();
const now = (row) => state.finds.find((find) => find.id === row.id) ?? row; // rows of the list stay while a find changes
const { box: pictures, show: showPictures } = picturesDialog();
document.body.append(pictures);
let absent = false;

export async function loadFinds() {
  try {
    state.finds = (await get("/api/finds")).filter((row) => position(row.lon_deg, row.lat_deg));
  } catch (error) {
    absent = error.status === 404;
  }
  changed("finds");
}

const WITHIN_95 = 2.45; // sigmas an axis; the same of both axes
const withinText = (sigma_m) => (sigma_m > 0 ? t("finds.within", { m: units.distance(WITHIN_95 * sigma_m) }) : t("finds.within.unknown"));

// A find that could not be saved keeps its place: somebody may have looked long for it.
async function save(find) {
  try {
    await post("/api/finds", find);
    await loadFinds();
  } catch (error) {
    if (error.status === 404 || error.status === 405) notice("bad", t("finds.absent"));
    else notice("bad", t("finds.failed", { note: find.note || t("finds.unnamed"), why: error.message }), [t("finds.retry"), () => save(find)]);
  }
}

async function remove(row) {
  try {
    await request("DELETE", `/api/finds/${encodeURIComponent(row.id)}`);
    notice("warn", t("finds.removed", { note: text(row.note) || t("finds.unnamed") }), [t("finds.restore"), () => save(row)]);
    await loadFinds();
  } catch (error) {
    notice("bad", t("finds.stays", { why: error.message }));
  }
}

// One find at a time is changed here. The first page that saves a change wins; the other keeps what it has typed, sees
// theirs in the list, and may save it over that.
function editor() {
  const note = make("input", { type: "text", maxlength: 200, "aria-label": t("finds.note") });
  const move = button(t("finds.move"), () => (tool.active === "find-move" ? still() : (takeTool("find-move", still), setText(move, t("finds.tap")))));
  const form = make("form", { class: "find-edit", onsubmit: store }, note, make("div", { class: "row wrap" }, move, button(t("confirm.no"), close), make("button", { type: "submit", class: "primary" }, t("finds.save"))));
  let draft = null;
  let place = null;
  function still() { dropTool("find-move"); setText(move, t(place ? "finds.moved" : "finds.move")); }
  function close() {
    draft = place = null;
    still();
    form.remove();
  }
  function open(row, line) {
    close();
    draft = row;
    note.value = text(row.note);
    line.append(form);
    note.focus();
  }
  map.on("click", (event) => {
    if (tool.active !== "find-move") return;
    const { lng, lat } = event.lngLat.wrap();
    place = { lat_deg: lat, lon_deg: lng, sigma_m: sigmaAt(lng, lat) };
    still();
  });
  async function store(event) {
    event.preventDefault();
    const { id, version, time, lat_deg, lon_deg, sigma_m } = draft;
    const body = { lat_deg, lon_deg, sigma_m, ...place, note: note.value.trim(), time, version };
    const name = body.note || t("finds.unnamed");
    try {
      await request("PUT", `/api/finds/${encodeURIComponent(id)}`, body);
      close();
      await loadFinds();
    } catch (error) {
      await loadFinds();
      const theirs = state.finds.find((row) => row.id === id);
      if (error.status === 409 && theirs && draft?.id === id) {
        draft = theirs;
        notice("bad", t("finds.elsewhere"));
      } else if (error.status === 404 && !theirs) {
        close();
        notice("bad", t("finds.gone", { note: name }), [t("finds.restore"), () => save(body)]);
      } else notice("bad", t("finds.failed", { note: name, why: error.message }));
    }
  }
  return { open, form };
}

export function findPanel() {
  const edit = editor();
  const note = make("input", { type: "text", maxlength: 200, placeholder: t("finds.note"), "aria-label": t("finds.note") });
  const mark = button(t("finds.mark"), () => (tool.active === "find" ? stop() : begin()));
  const look = button(t("finds.pictures.here"), () => (tool.active === "pictures" ? away() : (takeTool("pictures", away), setText(look, t("finds.tap")))));
  function away() { dropTool("pictures"); setText(look, t("finds.pictures.here")); }
  const list = make("ul", { class: "finds" });
  const about = make("p", { class: "quiet", role: "status" });
  const begin = () => { takeTool("find", stop); setText(mark, t("finds.tap")); };
  function stop() { dropTool("find"); setText(mark, t("finds.mark")); }
  map.on("click", async (event) => {
    const { lng, lat } = event.lngLat.wrap();
    if (tool.active === "pictures") {
      away();
      await showPictures({ lat_deg: lat, lon_deg: lng });
    }
    if (tool.active !== "find") return;
    stop();
    const words = note.value.trim();
    note.value = "";
    await save({ lat_deg: lat, lon_deg: lng, sigma_m: sigmaAt(lng, lat), note: words });
  });
  const draw = keyedList(list, (row) => make("li", {}, button("", () => map.flyTo({ center: [now(row).lon_deg, now(row).lat_deg], zoom: Math.max(18, map.getZoom()), duration: 0 }), { class: "find" }),
    button(t("finds.pictures"), () => showPictures(now(row)), { class: "small" }), button(t("finds.edit"), (event) => edit.open(now(row), event.target.closest("li")), { class: "small" }), button("×", () => remove(now(row)), { class: "close", "aria-label": t("finds.remove") })), (line, row) => {
    setText(line.firstChild, [`${text(row.note) || t("finds.unnamed")}: ${positionText(row.lat_deg, row.lon_deg, settings.coordinates)}`, withinText(row.sigma_m), timeOfDay(Date.parse(row.time))].filter(Boolean).join("; "));
  });
  subscribe("finds ready", "finds", () => {
    draw(state.finds.map((row) => [row.id, row]));
    setText(about, absent ? t("finds.absent") : state.finds.length ? "" : t("finds.none"));
    setHidden(about, !about.textContent);
    show("ellipses", state.finds.filter((row) => row.sigma_m > 0).map((row) => feature("Polygon", [circle([row.lon_deg, row.lat_deg], WITHIN_95 * row.sigma_m)])));
    for (const [id, marker] of markers) if (!state.finds.some((row) => row.id === id)) { marker.remove(); markers.delete(id); }
    for (const row of state.finds) {
      const [name, place] = [text(row.note) || t("finds.unnamed"), [row.lon_deg, row.lat_deg]];
      const marker = markers.get(row.id) ?? new maplibregl.Marker({ element: make("button", { type: "button", class: "find-marker" }, "★") }).setLngLat(place).setPopup(new maplibregl.Popup({ offset: 18 })).addTo(map);
      markers.set(row.id, marker.setLngLat(place));
      marker.getPopup().setText(name);
      setAttribute(marker.getElement(), "aria-label", t("finds.marker", { note: name }));
    }
  });
  return make("section", {}, make("h2", {}, t("finds.title")), make("div", { class: "row wrap" }, note, mark), make("div", { class: "row" }, look), about, list);
}
