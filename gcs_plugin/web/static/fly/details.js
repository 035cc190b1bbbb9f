// The selected vehicle: its figures in full, its commands, and what its autopilot says.

import { nowMs, timeOfDay } from "/static/core/clock.js";
import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { onSettings, settings } from "/static/core/settings.js";
import { changed, select, state, subscribe } from "/static/core/store.js";
import { positionText } from "/static/core/coordinates.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { inAir, need } from "/static/fly/need.js";
import { askOne } from "/static/fly/command_bar.js";
import { latestPicture } from "/static/fly/latest_picture.js";
import { wordOf } from "/static/fly/tiles.js";
import { lengthOf } from "/static/map/geodesy.js";
import { map } from "/static/map/map.js";
import { refine } from "/static/work/jobs.js";

// What only a vehicle on a link can say.
const OF_A_LINK = ["speed", "attitude", "gimbal", "battery", "gps", "home", "fence", "mission"];
const FACTS = ["state", "position", "height", "speed", "attitude", "gimbal", "battery", "gps", "link", "faults", "home", "fence", "mission", "pictures", "refined"];

const WARNING = 4; // MAV_SEVERITY: graver ones are lower

export function detailsPanel() {
  const name = make("h2", {});
  const why = make("p", { class: "why" });
  const cells = Object.fromEntries(FACTS.map((key) => [key, make("dd", {})]));
  const terms = Object.fromEntries(FACTS.map((key) => [key, make("dt", {}, t(`details.${key}`))]));
  const facts = make("dl", {}, ...FACTS.flatMap((key) => [terms[key], cells[key]]));
  const chosen = () => state.vehicles.get(state.selected);
  const verb = (key) => make("button", { type: "button", dataset: { verb: key }, onclick: () => chosen() && askOne(chosen(), key) }, t(`verb.${key}`));
  const linked = make("div", { class: "verbs", role: "group", "aria-label": t("details.commands") }, ...["pause", "resume", "rtl", "land", "continue", "start"].map(verb));
  const start = linked.lastChild;
  const messages = make("ul", { class: "messages", "aria-label": t("details.messages"), tabindex: "0" });
  const draw = keyedList(messages, () => make("li", {}), (row, message) => {
    const when = message.time == null ? "" : timeOfDay(message.time * 1000, { seconds: true });
    setText(row, [when, message.severity <= WARNING ? t(`severity.${message.severity}`) : "", message.text].filter(Boolean).join(" "));
    setAttribute(row, "data-severity", message.severity);
  });
  const silent = make("p", { class: "quiet" }, t("details.silent"));
  const heading = make("h3", {}, t("details.messages"));
  const box = make("aside", { class: "details", "aria-label": t("details.title"), hidden: true },
    make("div", { class: "row" }, name, button("×", () => select(null), { class: "close", "aria-label": t("details.close") })),
    why, linked, make("div", { class: "verbs" }, button(t("details.show"), () => chosen()?.position && map.flyTo({ center: chosen().position, zoom: Math.max(16, map.getZoom()), duration: 0 })),
      button(t("details.refine"), () => chosen() && refine(chosen().id))),
    latestPicture(), facts, heading, silent, messages);
  // In Plan and Map it covers the map only if it was opened there.
  let shownFor = null;
  let openedIn = "fly";
  onSettings((setting) => { if (setting === "mode") changed("selected"); });
  subscribe("vehicles selected tick completions", "details of a vehicle", () => {
    const row = chosen();
    if (state.selected !== shownFor) { shownFor = state.selected; openedIn = settings.mode; }
    const covered = settings.mode !== "fly" && settings.mode !== openedIn;
    setHidden(box, !row || covered);
    if (!row || covered) return;
    const wanted = need(row, nowMs());
    setText(name, row.name === row.id ? row.id : `${row.name} (${row.id})`);
    setText(why, wanted.why.map((item) => item.words).join("; "));
    for (const part of [linked, heading, messages]) setHidden(part, !row.linked);
    for (const key of OF_A_LINK) for (const cell of [terms[key], cells[key]]) setHidden(cell, !row.linked);
    start.disabled = inAir(row);
    setAttribute(start, "title", inAir(row) ? t("details.start.air") : null);
    const values = {
      state: row.linked ? [wordOf(row), row.mode, row.armed ? t("details.armed") : t("details.disarmed")].filter(Boolean).join(", ") : wordOf(row),
      position: row.position ? positionText(row.position[1], row.position[0], settings.coordinates) : "–",
      height: units.height(row.height_m), speed: `${units.speed(row.speed_m_s)}${row.climb_m_s ? `, ${t(row.climb_m_s > 0 ? "details.climbs" : "details.sinks", { speed: units.speed(Math.abs(row.climb_m_s)) })}` : ""}`,
      attitude: row.roll_deg == null || row.pitch_deg == null ? "–" : t("details.attitude.is", { roll: row.roll_deg, pitch: row.pitch_deg, heading: Math.round(row.heading_deg ?? 0) }),
      gimbal: row.gimbal_deg == null ? t("details.gimbal.none") : t(row.gimbal_deg < -80 ? "details.gimbal.down" : "details.gimbal.is", { pitch: row.gimbal_deg }),
      battery: `${units.percent(row.battery)}${row.battery_left_s == null ? "" : `, ${t("details.left", { time: units.clock(row.battery_left_s) })}`}`,
      gps: row.satellites == null ? "–" : t("details.satellites", { n: row.satellites }),
      link: row.linked ? `${row.link || "–"}, ${t("tile.heard", { age: units.ageText(Math.floor(wanted.age_s * 2) / 2) })}` : t("details.unlinked"),
      faults: faultsText(row.faults),
      home: row.home ? `${positionText(row.home[1], row.home[0], settings.coordinates)}${row.position ? `, ${t("details.away", { m: units.distance(lengthOf([row.home, row.position])) })}` : ""}` : "–",
      fence: fenceText(row.fence),
      mission: row.flight.items ? t("details.item", { item: row.flight.item, items: row.flight.items }) : "–",
      pictures: t("details.counts", { taken: Math.max(row.photos, row.frames.frames), ...row.frames }),
      refined: refinedText(row.id),
    };
    for (const key of FACTS) setText(cells[key], values[key]);
    for (const cell of [terms.faults, cells.faults]) setHidden(cell, !row.linked || !values.faults);
    const said = row.texts.toReversed();
    setHidden(silent, said.length > 0 || !row.linked);
    draw(said.map((message, k) => [k, message]));
  });
  return box;
}

const faultsText = ({ lost, damaged, impossible }) => [lost && t("details.faults.lost", { share: units.percent(lost) }), damaged && t("details.faults.damaged", { n: damaged }),
  impossible && t("details.faults.impossible", { n: impossible })].filter(Boolean).join("; ");

function fenceText(fence) {
  if (!fence) return t("details.fence.unread");
  if (!fence.zones.length) return t("details.fence.none");
  const inside = fence.zones.filter((zone) => zone.inside).length;
  return t("details.fence.read", { inside, outside: fence.zones.length - inside, time: fence.read_s == null ? "–" : timeOfDay(fence.read_s * 1000) });
}

function refinedText(vehicle) {
  const last = state.completions.filter((row) => row.vehicle === vehicle && row.refine_ended_s).pop();
  return last ? t("details.refined_s", { s: units.fixed(last.refine_ended_s - last.complete_s, 1) }) : "–";
}
