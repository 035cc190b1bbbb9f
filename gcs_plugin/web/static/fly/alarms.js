// Alarms by word, colour and sound: what needs a person now. A sound repeats until somebody has seen it; what was seen and
// gets worse is an alarm again, and Seen is for what is on the screen.

import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { settings } from "/static/core/settings.js";
import { changed, select, state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { need } from "/static/fly/need.js";

const REPEAT_MS = 4000;
let sound = null;
let last = 0;

function beep(level) {
  if (!settings.sound || performance.now() - last < 700) return;
  last = performance.now();
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

function raise(key, level, text, vehicle) {
  const known = state.alarms.get(key);
  if (!known) {
    state.alarms.set(key, { key, level, text, vehicle, seen: false, shown: null });
    beep(level);
  } else {
    if (worse(level, known.level)) {
      Object.assign(known, { seen: false, shown: null });
      beep(level);
    }
    Object.assign(known, { level, text });
  }
  return key;
}

// Alarms that events raise by themselves (separation) stay as long as the daemon says.
const announced = new Map();
export function announce(event) {
  const key = `daemon/${event.key ?? event.kind ?? event.text}`;
  if (event.active === false) announced.delete(key);
  else announced.set(key, { level: event.level === "warn" ? "warn" : "bad", text: String(event.text ?? event.kind), vehicle: event.vehicle });
  changed("alarms");
}

subscribe("vehicles tick commands alarms link", "alarms", () => {
  const now = performance.now();
  const standing = new Set();
  for (const row of state.vehicles.values()) {
    for (const item of need(row, now).why) {
      if (item.level === "stale") continue;
      standing.add(raise(`${row.id}/${item.key}`, item.level, `${row.name}: ${item.words}`, row.id));
    }
  }
  for (const [key, alarm] of announced) standing.add(raise(key, alarm.level, alarm.text, alarm.vehicle));
  if (state.link === "lost") standing.add(raise("daemon", "bad", t("link.banner.short")));
  for (const entry of state.commands) {
    if (entry.outcome === "unknown" || entry.outcome === "not_sent") standing.add(raise(entry.key, "bad", `${entry.name}: ${t(`verb.${entry.verb}`)} ${t(`outcome.${entry.outcome}`)}`, entry.vehicle));
  }
  for (const key of [...state.alarms.keys()]) if (!standing.has(key)) state.alarms.delete(key);
  changed("alarm-list");
});

const rows = () => (innerWidth <= 700 || innerHeight <= 600 ? 3 : 5);
const READ_MS = 300; // what came up just before the press was not read

export function alarmList() {
  const list = make("ul", {});
  let drawn = [];
  const seen = button(t("alarm.seen"), () => {
    for (const alarm of drawn) if (performance.now() - alarm.shown > READ_MS) alarm.seen = true;
    changed("alarm-list");
  }, { class: "small" });
  const title = make("b", {});
  const more = make("p", { class: "more" });
  const box = make("section", { class: "alarms", "aria-label": t("alarm.title"), role: "alert", hidden: true }, make("div", { class: "row" }, title, seen), list, more);
  const draw = keyedList(list, (alarm) => make("li", {}, button("", () => alarm.vehicle && select(alarm.vehicle), { class: "alarm" })), (row, alarm) => {
    setText(row.firstChild, `${t(`alarm.${alarm.level}`)} ${alarm.text}`);
    setAttribute(row, "data-level", alarm.level);
  });
  subscribe("alarm-list", "list of alarms", () => {
    const fresh = [...state.alarms.values()].filter((alarm) => !alarm.seen).sort((a, b) => (a.level === "bad" ? 0 : 1) - (b.level === "bad" ? 0 : 1));
    drawn = fresh.slice(0, rows());
    for (const alarm of fresh) alarm.shown = drawn.includes(alarm) ? alarm.shown ?? performance.now() : null;
    setText(title, t("alarm.count", { n: fresh.length }));
    draw(drawn.map((alarm) => [alarm.key, alarm]));
    setText(more, fresh.length > drawn.length ? t("alarm.more", { n: fresh.length - drawn.length }) : "");
    setHidden(more, fresh.length === drawn.length);
    setHidden(box, fresh.length === 0);
  });
  setInterval(() => {
    const loud = [...state.alarms.values()].find((alarm) => !alarm.seen && alarm.level === "bad");
    if (loud) beep("bad");
  }, REPEAT_MS);
  return box;
}
