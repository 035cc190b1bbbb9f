// Alarms by word, colour and sound: what needs a person now, one line a cause. A sound repeats until somebody has seen it;
// what was seen and gets worse is an alarm again, and Seen is for what is on the screen. What the operator has ordered is none.

import { nowMs, timeOfDay } from "/static/core/clock.js";
import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { settings } from "/static/core/settings.js";
import { changed, select, state, subscribe } from "/static/core/store.js";
import { given } from "/static/core/stream.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { inAir, need } from "/static/fly/need.js";
import { aircraftNear } from "/static/fly/aircraft.js";

const REPEAT_MS = 4000;
let sound = null;
let last = 0;

// Browsers let a page sound only after a press on it; one that stays silent until then would stay silent for good.
for (const kind of ["pointerup", "keydown"]) document.addEventListener(kind, () => { if (sound && sound.state !== "running") sound.resume?.(); }, true);

function beep(level) {
  if (!settings.sound || nowMs() - last < 700) return;
  last = nowMs();
  try {
    sound ??= new AudioContext();
    for (const [k, hertz] of (level === "bad" ? [880, 660, 880] : [660]).entries()) {
      const [tone, loud] = [sound.createOscillator(), sound.createGain()];
      const at = sound.currentTime + k * 0.18;
      tone.frequency.value = hertz;
      loud.gain.setValueAtTime(0.15, at);
      loud.gain.exponentialRampToValueAtTime(0.001, at + 0.16);
      tone.connect(loud).connect(sound.destination);
      tone.start(at);
      tone.stop(at + 0.17);
    }
  } catch { /* a browser without sound: word and colour stay */ }
}

const worse = (level, than) => level === "bad" && than !== "bad";

function say(text) {
  if (settings.speak && window.speechSynthesis) speechSynthesis.speak(Object.assign(new SpeechSynthesisUtterance(text), { lang: document.documentElement.lang }));
}

// cause: what alarms of several vehicles have in common; they are one line then.
function raise(key, level, text, vehicle, cause) {
  const known = state.alarms.get(key);
  if (!known || worse(level, known.level)) {
    beep(level);
    say(`${t(`alarm.${level}`)}. ${text}`);
  }
  if (!known) {
    state.alarms.set(key, { key, level, text, vehicle, cause, seen: false, shown: null });
    past.unshift({ key, level, text, begun: Date.now(), ended: null });
    past.splice(MOST_PAST);
  } else {
    if (worse(level, known.level)) Object.assign(known, { seen: false, shown: null });
    Object.assign(known, { level, text });
  }
  return key;
}

// What was an alarm since the page was opened, newest first.
const MOST_PAST = 300;
const past = [];

// Alarms that events raise by themselves stay as long as the daemon says.
const announced = new Map();
export function announce(event) {
  const key = `daemon/${event.key ?? event.kind ?? event.text}`;
  if (event.active === false) announced.delete(key);
  else announced.set(key, { level: event.level === "warn" ? "warn" : "bad", text: String(event.text ?? event.kind), vehicle: event.vehicle });
  changed("alarms");
}

// Vehicles that are too near each other. Events tell a pair at once; the `alarm` of the rows says what stands now, also to
// a page that was opened later or missed an event.
const ROWS_MS = 3000; // rows come each second
const pairs = new Map();
export function near(pair, active, event) {
  const key = `near/${pair.join("/") || event.vehicle}`;
  if (!active) pairs.delete(key);
  else pairs.set(key, { pair, level: "bad", text: String(event.text), vehicle: String(event.vehicle), at: nowMs() });
  changed("alarms");
}

function tooNear(now) {
  const rows = (pair) => pair.map((id) => state.vehicles.get(id)).filter(Boolean);
  for (const [key, { pair, at }] of pairs) {
    const both = rows(pair);
    if (now - at > ROWS_MS && both.every((row) => row.alarm === "" && row.at > at)) pairs.delete(key);
  }
  const found = [...pairs].map(([key, alarm]) => {
    const [one, other] = rows(alarm.pair);
    return [key, one?.alarm && one.alarm === other?.alarm ? { ...alarm, text: one.alarm } : alarm];
  });
  const told = new Set([...pairs.values()].flatMap((alarm) => alarm.pair));
  const others = [...state.vehicles.values()].filter((row) => row.alarm && !told.has(row.id));
  for (const text of new Set(others.map((row) => row.alarm))) { // both of a pair say the same
    const ids = others.filter((row) => row.alarm === text).map((row) => row.id).sort();
    found.push([`near/${ids.join("/")}`, { level: "bad", text, vehicle: ids[0] }]);
  }
  return found;
}

// What happened once stays until it was seen: what an autopilot says of severity 0 (emergency) to 3 (error), a restart in
// the air, a mission that ended early. What it says of its own checks before arming is in the list before a start.
const SEVERE = 3;
const CHECKS = /^(PreArm|Arm|Preflight Fail): /i;
const AGAIN_MS = 30_000; // the same words in a row are one alarm
const OLD_S = 300; // before the page was opened
const ROUND_S = 0.2; // rows give times in tenths, events in full
const once = new Map();
const heardTexts = new Map(); // vehicle -> time of the newest text that was looked at

const clockText = (time_s) => (time_s == null ? "" : `${timeOfDay(time_s * 1000, { seconds: true })} `);

function tell(vehicle, level, words, time_s) {
  const key = `once/${vehicle}/${words}`;
  const [known, now] = [once.get(key), nowMs()];
  const name = state.vehicles.get(vehicle)?.name ?? vehicle;
  if (known && state.alarms.get(key)?.seen && now - known.at > AGAIN_MS) state.alarms.delete(key);
  once.set(key, { level, text: `${clockText(time_s)}${name}: ${words}`, vehicle, words, at: now });
  changed("alarms");
}

function said(vehicle, message) {
  if (message.severity > SEVERE || CHECKS.test(message.text)) return;
  tell(vehicle, "bad", t("alarm.said", { text: message.text }), message.time);
}

export function happened(event) {
  const vehicle = String(event.vehicle);
  const row = state.vehicles.get(vehicle);
  const time_s = Number.isFinite(event.time) ? event.time : null;
  if (event.said) said(vehicle, { text: String(event.said), severity: event.severity ?? 6, time: time_s });
  if (event.kind === "rebooted" && row && (row.armed || inAir(row))) tell(vehicle, "bad", t("alarm.rebooted"), time_s);
  if (event.kind === "aborted") tell(vehicle, "warn", t("alarm.aborted"), time_s);
}

// What was said before the page was opened, or while it missed events.
function earlier(row, now_s) {
  if (now_s == null) return;
  const since = heardTexts.get(row.id) ?? now_s - OLD_S;
  for (const message of row.texts) if (message.time != null && message.time > since + ROUND_S && !heardNow(row.id, message)) said(row.id, message);
  const newest = Math.max(since, ...row.texts.map((message) => message.time ?? 0));
  heardTexts.set(row.id, newest);
}
const heardNow = (vehicle, message) => once.has(`once/${vehicle}/${t("alarm.said", { text: message.text })}`);

subscribe("vehicles tick commands alarms link traffic", "alarms", () => {
  const now = nowMs();
  const standing = new Set();
  for (const row of state.vehicles.values()) {
    for (const item of need(row, now).why) {
      if (item.level === "stale" || item.quiet) continue;
      standing.add(raise(`${row.id}/${item.key}`, item.level, `${row.name}: ${item.words}`, row.id, item.key));
    }
    earlier(row, given().given_s);
  }
  for (const [key, alarm] of [...announced, ...tooNear(now), ...aircraftNear()]) standing.add(raise(key, alarm.level, units.inUnits(alarm.text), alarm.vehicle, key)); // each says what to do: a line of its own
  for (const [key, alarm] of once) {
    if (state.alarms.get(key)?.seen && now - alarm.at > AGAIN_MS) once.delete(key);
    else standing.add(raise(key, alarm.level, alarm.text, alarm.vehicle, alarm.words));
  }
  if (state.link === "lost") standing.add(raise("daemon", "bad", t("link.banner.short"), undefined, "station"));
  for (const entry of state.commands) {
    if (entry.outcome === "unknown" || entry.outcome === "not_sent") standing.add(raise(entry.key, "bad", `${entry.name}: ${t(`verb.${entry.verb}`)} ${t(`outcome.${entry.outcome}`)}`, entry.vehicle, `${entry.verb}/${entry.outcome}`));
  }
  for (const key of [...state.alarms.keys()]) {
    if (standing.has(key)) continue;
    state.alarms.delete(key);
    for (const one of past) if (one.key === key) one.ended ??= Date.now();
  }
  changed("alarm-list");
});

const rows = () => (innerHeight <= 450 ? 2 : innerWidth <= 700 || innerHeight <= 600 ? 3 : 5); // what fits without scrolling
const READ_MS = 300; // what came up just before the press was not read
const MOST_NAMES = 12;

// Alarms with one cause as one: {key, level, text, all}.
function grouped(alarms) {
  const groups = new Map();
  for (const alarm of alarms) {
    const key = `${alarm.level}/${alarm.cause}`;
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(alarm);
  }
  return [...groups].map(([key, all]) => {
    const names = [...new Set(all.map((alarm) => state.vehicles.get(alarm.vehicle)?.name ?? alarm.vehicle))];
    const title = t(`alarm.of.${all[0].cause}`);
    const listed = names.slice(0, MOST_NAMES).join(", ") + (names.length > MOST_NAMES ? ` ${t("alarm.more", { n: names.length - MOST_NAMES })}` : "");
    const words = title === `alarm.of.${all[0].cause}` ? all[0].text.replace(/^.*?: /, "") : title;
    return { key, level: all[0].level, all, text: all.length === 1 ? all[0].text : `${words}: ${listed}` };
  });
}

function makeLine() {
  const row = make("li", {}, button("", () => row.vehicle && select(row.vehicle), { class: "alarm" }));
  return row;
}

export function alarmList() {
  const list = make("ul", {});
  let drawn = [];
  const seen = button(t("alarm.seen"), () => {
    for (const alarm of drawn.flatMap((group) => group.all)) if (nowMs() - alarm.shown > READ_MS) alarm.seen = true;
    changed("alarm-list");
  }, { class: "small" });
  const title = make("b", {});
  const more = make("p", { class: "more" });
  const box = make("section", { class: "alarms", "aria-label": t("alarm.title"), role: "alert", hidden: true }, make("div", { class: "row" }, title, seen), list, more);
  const draw = keyedList(list, makeLine, (row, group) => {
    row.vehicle = group.all[0].vehicle;
    setText(row.firstChild, `${t(`alarm.${group.level}`)} ${group.text}`);
    setAttribute(row, "data-level", group.level);
  });
  subscribe("alarm-list", "list of alarms", () => {
    const fresh = [...state.alarms.values()].filter((alarm) => !alarm.seen);
    const groups = grouped(fresh).sort((a, b) => (a.level === "bad" ? 0 : 1) - (b.level === "bad" ? 0 : 1));
    drawn = groups.slice(0, rows());
    const listed = new Set(drawn.flatMap((group) => group.all));
    for (const alarm of fresh) alarm.shown = listed.has(alarm) ? alarm.shown ?? nowMs() : null;
    setText(title, t("alarm.count", { n: fresh.length }));
    draw(drawn.map((group) => [group.key, group]));
    setText(more, groups.length > drawn.length ? t("alarm.more", { n: groups.length - drawn.length }) : "");
    setHidden(more, groups.length === drawn.length);
    setHidden(box, fresh.length === 0);
  });
  setInterval(() => {
    const loud = [...state.alarms.values()].find((alarm) => !alarm.seen && alarm.level === "bad");
    if (loud) beep("bad");
  }, REPEAT_MS);
  return box;
}

// What was an alarm and is over, or still is, with its times.
export function pastAlarms() {
  const list = make("ul", { class: "past" });
  const title = make("summary", {});
  const box = make("details", { hidden: true }, title, list);
  const draw = keyedList(list, () => make("li", {}), (row, one) => {
    const time = (ms) => timeOfDay(ms, { seconds: true });
    setText(row, `${time(one.begun)}${one.ended ? ` – ${time(one.ended)}` : ""} ${t(`alarm.${one.level}`)} ${one.text}`);
    setAttribute(row, "data-level", one.level);
  });
  subscribe("alarm-list", "alarms so far", () => {
    setText(title, t("alarm.past", { n: past.length }));
    setHidden(box, !past.length);
    if (box.open) draw(past.map((one) => [`${one.key}/${one.begun}`, one]));
  });
  box.addEventListener("toggle", () => changed("alarm-list"));
  return box;
}
