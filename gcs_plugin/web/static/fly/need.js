// What a vehicle needs of a person: its level (ok, stale, warn, bad) and why, in words. One place for tiles, map and alarms.

import { age } from "/static/core/values.js";
import { t } from "/static/core/strings.js";
import { ageText, inUnits, percent } from "/static/core/units.js";
import { state } from "/static/core/store.js";

const STALE_S = 2;
export const LOST_S = 5;
const LOW = 0.25;
const EMPTY = 0.12;
const WEIGHT = { bad: 3, warn: 2, stale: 1, ok: 0 };

const GROUND = new Set(["on ground", "complete"]);
const offGround = (row) => row.armed && row.landed !== "on ground";
// One that is lost counts as where it was heard last: it is in the air until somebody knows better.
export const inAir = (row) => {
  if (row.flight.state === "lost") return offGround(row);
  return row.flight.state ? !GROUND.has(row.flight.state) : row.linked && row.armed && row.flight.text !== "on ground";
};
export const isLost = (row) => row.flight.state === "lost" || row.state === "lost" || row.former === true;
// What it holds as read from it, if that is known: {points: [item, longitude, latitude]}.
export const heldRoute = (row) => (row.linked && row.route ? state.routes.find((one) => one.vehicle === row.id && one.route === row.route) : undefined);
// The station can send it commands.
export const onLink = (row) => row.linked && !row.former;
// Its propellers can turn any moment.
export const armedOnGround = (row) => row.linked && row.armed && !inAir(row);

export function need(row, now) {
  if (!row.linked) return { level: "ok", why: [], age_s: null, weight: 0, old: state.link !== "live" };
  const age_s = age(row, now);
  const silent_s = age_s - (state.link === "live" ? 0 : state.silent_s); // while the station is not heard, nobody knows of it
  const why = [];
  const add = (level, key, words) => why.push({ level, key, words });
  if (row.former) add(age_s > LOST_S ? "bad" : "stale", "link", t("need.former", { age: ageText(age_s) }));
  else if (silent_s > LOST_S || row.state === "lost") add("bad", "link", t("need.link", { age: ageText(age_s) }));
  else if (age_s > STALE_S || state.link !== "live") add("stale", "stale", t("need.stale", { age: ageText(age_s) }));
  if (row.state === "conflict") add("warn", "twins", t("need.twins"));
  if (row.battery != null && row.battery < EMPTY) add("bad", "battery", t("need.empty", { share: percent(row.battery) }));
  else if (row.battery != null && row.battery < LOW) add("warn", "battery", t("need.low", { share: percent(row.battery) }));
  if (row.gps_fix != null && row.gps_fix < 3) add(inAir(row) ? "bad" : "warn", "gps", t("need.gps"));
  if (armedOnGround(row) && !isLost(row)) why.push({ level: "warn", key: "armed", words: t("need.armed"), quiet: true }); // at each takeoff: no alarm
  if (row.alarm) why.push({ level: "bad", key: "alarm", words: inUnits(row.alarm), quiet: true }); // an alarm of its own
  if (row.behind) why.push({ level: "warn", key: "behind", words: inUnits(row.behind), quiet: row.ordered });
  if (row.takeoff?.failed) add("warn", "takeoff", row.takeoff.failed);
  const level = why.reduce((worst, item) => (WEIGHT[item.level] > WEIGHT[worst] ? item.level : worst), "ok");
  return { level, why, age_s, weight: WEIGHT[level], old: age_s > STALE_S || state.link !== "live" };
}
