// How much of the area was seen, what was missed and why; a press on a gap goes there.

import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { openGapFlight } from "/static/coverage/flight.js";
import "/static/coverage/layer.js";
import { drawnSince } from "/static/plan/outdated.js";
import { boundsOf, fit } from "/static/map/map.js";
import { shownSwitch } from "/static/map/shown.js";

const MOST = 30;
const STATES = ["seen", "poor", "missed", "planned"];
const percent = (share) => units.percent(share ?? 0, share > 0.999 && share < 1 ? 2 : 1);
const nameOf = (id) => state.vehicles.get(id)?.name ?? id;

function zoom(gap) {
  const bounds = boundsOf(gap.polygon?.coordinates?.[0] ?? []);
  if (bounds) fit(bounds);
}

// Missing pictures of a vehicle with one cause as one line.
function missingRows(rows) {
  const groups = new Map();
  for (const row of rows) {
    const key = `${row.vehicle}/${row.cause}`;
    if (!groups.has(key)) groups.set(key, { ...row, n: 0 });
    groups.get(key).n += 1;
  }
  return [...groups];
}

// Pictures asked from the vehicles, by vehicle: how many of each state, and each by its number when unfolded.
function requestsByVehicle(rows) {
  const groups = new Map();
  for (const row of rows) {
    if (!groups.has(row.vehicle)) groups.set(row.vehicle, []);
    groups.get(row.vehicle).push(row);
  }
  return [...groups];
}

function makeRequests() {
  const row = make("li", {}, make("details", {}, make("summary", {}), make("ul", {})));
  row.line = row.querySelector("summary");
  row.draw = keyedList(row.querySelector("ul"), () => make("li", {}), (line, one) => {
    const words = one.state === "waiting" && one.reason ? "held" : one.state;
    setText(line, t(`coverage.asked.${words}`, one));
  });
  return row;
}

function drawRequests(row, rows) {
  const count = (state) => rows.filter((one) => one.state === state).length;
  const [arrived, refused] = [count("arrived"), count("refused")];
  setText(row.line, t("coverage.asked.title", { name: nameOf(rows[0].vehicle), n: rows.length, arrived, refused, open: rows.length - arrived - refused }));
  row.draw(rows.map((one) => [String(one.number), one]));
}

export function coveragePanel() {
  const shares = make("p", {});
  const figures = Object.fromEntries(STATES.map((key) => [key, make("b", {})]));
  const legend = make("ul", { class: "shares" }, ...STATES.map((key) => make("li", {}, make("i", { class: "swatch", "aria-hidden": "true", dataset: { state: key } }), make("span", {}, t(`coverage.${key}`)), figures[key])));
  const recorded = make("p", { class: "quiet" });
  const gapsTitle = make("p", {});
  const list = make("ul", { class: "gaps" });
  const more = make("p", { class: "quiet" });
  const missing = make("ul", { class: "quiet" });
  const asked = make("ul", { class: "quiet requests" });
  const drawAsked = keyedList(asked, makeRequests, drawRequests);
  const offers = make("ul", { class: "warnings" });
  const fly = button(t("coverage.fly"), openGapFlight);
  const toggle = shownSwitch("coverage", t("coverage.show"));
  const drawGaps = keyedList(list, () => { const row = make("li", {}, button("", () => zoom(row.gap))); return row; }, (row, gap) => {
    row.gap = gap;
    const cause = [gap.cause, gap.detail && `(${gap.detail})`, gap.vehicle && nameOf(gap.vehicle)].filter(Boolean).join(" ");
    const sure = gap.confidence < 0.995 ? `, ${t("coverage.sure", { sure: units.percent(gap.confidence) })}` : "";
    setText(row.firstChild, t("coverage.gap", { size: units.area(gap.area_m2), cause }) + sure);
    setAttribute(row, "data-poor", gap.detail ? "true" : "false");
  });
  const drawMissing = keyedList(missing, () => make("li", {}), (row, group) => setText(row, t("coverage.missing.row", { name: nameOf(group.vehicle), n: group.n, cause: group.cause, first: group.n > 1 ? t("coverage.missing.first", { image: group.image }) : group.image })));
  const box = make("section", { class: "coverage" }, make("h2", {}, t("coverage.title")), shares, legend, recorded, toggle, offers, gapsTitle, list, more, fly, missing, asked);
  subscribe("coverage vehicles zones", "coverage", () => {
    const now = state.coverage;
    const known = now?.seen_share != null;
    for (const part of [legend, recorded, toggle, offers, gapsTitle, list, more, fly, missing, asked]) setHidden(part, !known);
    if (!known) { setText(shares, t("coverage.none")); return; }
    setText(shares, [t(`coverage.state.${now.state}`), now.plan && drawnSince() ? t("coverage.older") : ""].filter(Boolean).join(" "));
    for (const key of STATES) setText(figures[key], percent(now[`${key}_share`]));
    setText(recorded, t("coverage.recorded", { seen: percent(now.recorded.seen_share), placed: now.pictures.placed, left: now.pictures.recorded }));
    setText(gapsTitle, now.gaps.length ? t("coverage.gaps", { n: now.gaps.length, size: units.area(now.gaps.reduce((sum, gap) => sum + gap.area_m2, 0)) }) : t("coverage.nogaps"));
    drawGaps(now.gaps.slice(0, MOST).map((gap) => [`${gap.lat_deg},${gap.lon_deg},${gap.cause}`, gap]));
    setHidden(more, now.gaps.length <= MOST);
    setText(more, t("coverage.more", { n: now.gaps.length - MOST }));
    fly.disabled = !now.gaps.length;
    offers.replaceChildren(...(now.offers ?? []).map((row) => make("li", {}, t("coverage.offer", { name: nameOf(row.vehicle), legs: row.legs, length: units.distance(row.length_m) }))));
    drawMissing(missingRows(now.missing_pictures));
    drawAsked(requestsByVehicle(now.requests ?? []));
  });
  return box;
}
