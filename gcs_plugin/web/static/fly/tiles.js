// The strip of vehicle tiles. A tile is made once, stays where it is, and changes in place: no press is lost, and the
// keyboard's focus stays. The order changes only when the person asks for it.

import { nowMs, timeOfDay } from "/static/core/clock.js";
import { button, choice, make, setAttribute, setHidden, setStyle, setText } from "/static/core/dom.js";
import { guarded } from "/static/core/guard.js";
import { setSetting, settings } from "/static/core/settings.js";
import { select, state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { colourOf } from "/static/map/colours.js";
import { armedOnGround, inAir, isLost, need } from "/static/fly/need.js";

const FIX = ["", "", "2D", "3D", "DGPS", "RTK~", "RTK"];
// What only a vehicle on a link can say.
const OF_A_LINK = ["speed", "battery", "gps", "age"];
const PARTS = ["height", "speed", "battery", "gps", "age", "pictures"];
const SENDING_MS = 60_000; // a picture that came longer ago may be of an earlier flight
const tiles = new Map();
const list = make("ul", { class: "tiles", "aria-label": t("fly.vehicles") });
const search = make("input", { type: "search", placeholder: t("fly.search"), "aria-label": t("fly.search"), oninput: refilter });
const filter = choice(["all", "need", "air", "ground"].map((key) => [key, t(`fly.filter.${key}`)]), "all", refilter, t("fly.filter"));
const count = make("p", { class: "quiet", role: "status" });
const nothing = make("p", { class: "quiet" }, t("fly.none"));

export function stripOf() {
  const sort = choice(["name", "need"].map((key) => [key, t(`fly.sort.${key}`)]), settings.sort, (value) => { setSetting("sort", value); order(); }, t("fly.sort"));
  const again = button(t("fly.again"), () => order(), { class: "small", title: t("fly.again.hint") });
  return make("div", { class: "strip" }, make("div", { class: "row tools" }, search, filter, sort, again), count, nothing, list);
}

function create(row) {
  const cells = Object.fromEntries(PARTS.map((key) => [key, make("span", { class: `cell ${key}`, title: t(`tile.${key}`) })]));
  const [name, word, why] = [make("b", {}), make("span", { class: "word" }), make("span", { class: "why" })];
  const bar = make("i", {});
  const press = make("button", { type: "button", class: "tile", "aria-pressed": "false", onclick: () => select(row.id) },
    make("span", { class: "head" }, name, word), make("span", { class: "cells" }, ...Object.values(cells)), why, make("span", { class: "bar" }, bar));
  setStyle(press, "--colour", colourOf(row.id));
  const item = make("li", { dataset: { id: row.id } }, press);
  const tile = { item, press, name, word, why, bar, cells };
  tiles.set(row.id, tile);
  list.append(item);
  return tile;
}

// What is known of one that was not heard on a link since the station began.
export function pictureWord(row) {
  if (row.came_s == null) return t("state.pictures.none");
  const ago_ms = 1000 * row.came_s + nowMs() - row.at;
  return ago_ms > SENDING_MS ? t("state.pictures.last", { time: timeOfDay(Date.now() - ago_ms) }) : t("state.pictures");
}

export function wordOf(row) {
  if (!row.linked) return pictureWord(row);
  if (isLost(row)) return t(inAir(row) ? "state.lost.air" : armedOnGround(row) ? "state.lost.armed" : "state.lost.ground");
  if (armedOnGround(row)) return t("state.armed");
  if (row.returnsAfter) return t("state.returns", { after: row.returnsAfter.map((id) => state.vehicles.get(id)?.name ?? id).join(", ") || "–" });
  if (row.takeoff?.in_s != null) return t("state.waiting", { time: units.clock(row.takeoff.in_s) });
  return row.flight.state ? row.flight.text : [row.flight.text, row.mode].filter(Boolean).join(", ") || t("state.unknown");
}

const update = (row, now) => {
  const tile = tiles.get(row.id) ?? create(row);
  const { level, why, age_s, old } = need(row, now);
  setText(tile.name, row.name);
  setText(tile.word, wordOf(row));
  setText(tile.cells.height, units.height(row.height_m));
  setText(tile.cells.speed, units.speed(row.speed_m_s));
  for (const key of OF_A_LINK) setHidden(tile.cells[key], !row.linked);
  setText(tile.cells.battery, t("tile.batt", { left: `${units.percent(row.battery)}${row.battery_left_s == null ? "" : ` ${units.clock(row.battery_left_s)}`}` }));
  setText(tile.cells.gps, t("tile.fix", { fix: FIX[row.gps_fix] || t("tile.nofix"), n: row.satellites ?? "–" }));
  setText(tile.cells.age, age_s == null ? "–" : t("tile.heard", { age: units.ageText(Math.floor(age_s * 2) / 2) }));
  setText(tile.cells.pictures, t("tile.counts", { taken: Math.max(row.photos, row.frames.frames), come: row.frames.frames }));
  setText(tile.why, why.map((item) => item.words).join("; "));
  const share = row.phase === "complete" ? 1 : row.flight.items ? row.flight.item / row.flight.items : 0;
  setStyle(tile.bar, "transform", `scaleX(${Math.min(1, share).toFixed(3)})`);
  setAttribute(tile.press, "data-level", level);
  setAttribute(tile.press, "data-old", old);
  setAttribute(tile.press, "aria-pressed", state.selected === row.id ? "true" : "false");
};

const matches = (row, now) => {
  const words = search.value.trim().toLowerCase();
  if (words && !`${row.name} ${row.id}`.toLowerCase().includes(words)) return false;
  if (filter.value === "need") return need(row, now).weight > 1;
  return filter.value === "all" || (filter.value === "air") === inAir(row);
};

function refilter() {
  const now = nowMs();
  for (const [id, tile] of tiles) setHidden(tile.item, !matches(state.vehicles.get(id), now));
}

const byName = new Intl.Collator(undefined, { numeric: true });

function order() {
  const now = nowMs();
  const rows = [...tiles.keys()].map((id) => state.vehicles.get(id));
  const weight = (row) => (settings.sort === "need" ? need(row, now).weight : 0);
  rows.sort((a, b) => weight(b) - weight(a) || byName.compare(a.name, b.name));
  rows.forEach((row, k) => {
    const { item } = tiles.get(row.id);
    if (list.children[k] !== item) list.insertBefore(item, list.children[k] ?? null);
  });
}

subscribe("vehicles selected tick", "vehicle tiles", () => {
  const now = nowMs();
  const before = tiles.size;
  for (const [id, tile] of tiles) if (!state.vehicles.has(id)) { tile.item.remove(); tiles.delete(id); }
  for (const row of state.vehicles.values()) guarded(`tile of ${row.id}`, update)(row, now);
  if (tiles.size !== before && !list.contains(document.activeElement)) order();
  setHidden(nothing, tiles.size > 0);
  setAttribute(list, "data-size", tiles.size > 24 ? "many" : tiles.size > 6 ? "some" : "few");
  const rows = [...state.vehicles.values()];
  const alarmed = new Set([...state.alarms.values()].filter((alarm) => alarm.level === "bad").map((alarm) => alarm.vehicle));
  const level = (row) => (alarmed.has(row.id) ? "bad" : need(row, now).level);
  const of = (wanted) => rows.filter((row) => level(row) === wanted).length;
  setText(count, rows.length ? t("fly.count", { n: rows.length, air: rows.filter(inAir).length, bad: of("bad"), warn: of("warn") }) : "");
  if (filter.value !== "all") refilter();
});
