// Before a start: what starts, when and how high, and the daemon's check of each vehicle. Red stops the start; each red
// item can be allowed by itself, never all at once. While something is red the check is repeated: a receiver gets its
// fix, a filter settles.

import { post, request } from "/static/core/api.js";
import { dialogBox } from "/static/core/dialog.js";
import { button, keyedList, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state } from "/static/core/store.js";
import { given } from "/static/core/stream.js";
import { t } from "/static/core/strings.js";
import * as units from "/static/core/units.js";
import { newId } from "/static/fly/commands.js";
import { routeName } from "/static/plan/route_names.js";

const CHECK_MS = 60_000;
const REPEAT_MS = 5_000;
const REST = 3; // pause after a check, in multiples of its time: it reads missions from the vehicles
const nameOf = (id) => state.vehicles.get(id)?.name ?? id;
const title = make("h2", { id: "preflight-title" });
const facts = make("ul", { class: "starts" });
const checks = make("div", { class: "checks" });
const status = make("p", { role: "status" });
const again = button(t("preflight.again"), () => check());
const no = button(t("confirm.no"), () => leave());
const go = button(t("preflight.start"), () => start(), { class: "primary" });
const dialog = dialogBox({ class: "preflight", "aria-labelledby": "preflight-title" }, title, make("p", { class: "quiet" }, t("preflight.about")), facts, checks, status,
  make("div", { class: "row wrap" }, again, no, go));
dialog.box.addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || !begun) return;
  event.stopImmediatePropagation();
  leave();
}, true);
export const preflightDialog = () => dialog.box;

let plan = null;
let names = {};
let rows = null;
let allowed = {};
let turn = 0; // a newer check or a start makes answers to older ones void
let timer = 0;
let wrong = () => "";
let begun = null; // the start that was asked for and has not been answered: its request

// problem: gives a sentence if the plan must not be flown any more, for example as its area was changed meanwhile.
export function openPreflight(chosen, vehicles, problem = () => "") {
  plan = chosen;
  wrong = problem;
  names = vehicles;
  allowed = {};
  setText(title, t("preflight.title", { n: plan.vehicles.length }));
  dialog.open();
  check();
}

async function check(repeated = false) {
  clearTimeout(timer);
  const mine = ++turn;
  const began = Date.now();
  if (!repeated) {
    rows = null;
    setText(status, t("preflight.checking"));
    draw();
  }
  try {
    const answer = await post(`/api/plans/${plan.id}/preflight`, { sortie: 1, vehicles: names }, CHECK_MS);
    if (mine !== turn) return;
    rows = Array.isArray(answer?.checks) ? answer.checks : [];
    setText(status, "");
  } catch (error) {
    if (mine !== turn) return;
    setText(status, error.status === 404 || error.status === 405 ? t("preflight.absent") : t("preflight.failed", { why: error.message }));
  }
  draw();
  if (stopped().length) timer = setTimeout(() => { if (dialog.box.open) check(true); }, Math.max(REPEAT_MS, REST * (Date.now() - began)));
}

const stopped = () => (rows ?? []).flatMap((row) => row.items.filter((item) => item.state === "red" && !allowed[row.vehicle]?.has(item.name)));

// What starts: vehicle, mission, height and times, as the daemon will fly them.
function drawFacts() {
  const first = Math.min(...plan.vehicles.map((row) => row.flights?.[0]?.start_s ?? 0));
  facts.replaceChildren(...plan.vehicles.map((part) => {
    const row = (rows ?? []).find((checked) => checked.vehicle === names[part.id]);
    return make("li", {}, make("b", {}, nameOf(names[part.id])), t("preflight.fact", {
      route: routeName(part.id), height: units.height(row?.height_m), at: units.clock((part.flights?.[0]?.start_s ?? 0) - first), time: units.clock(row?.time_s ?? part.time_s), photos: part.photos }));
  }));
}

function draw() {
  drawFacts();
  drawChecks((rows ?? []).map((row) => [row.vehicle, row]));
  refresh();
}

const drawChecks = keyedList(checks, () => {
  const section = make("section", {}, make("h3", {}), make("ul", {}));
  section.draw = keyedList(section.lastChild, makeLine, drawLine);
  return section;
}, (section, row) => {
  setAttribute(section, "data-level", row.state);
  setText(section.firstChild, `${nameOf(row.vehicle)}: ${t(`preflight.state.${row.state}`)}`);
  section.draw(row.items.map((item) => [item.name, { ...item, vehicle: row.vehicle }]));
});

function refresh() {
  const left = stopped();
  go.disabled = rows == null || left.length > 0;
  setText(go, rows && left.length ? t("preflight.stopped", { n: left.length }) : t("preflight.start", { n: plan?.vehicles.length ?? 0 }));
}

function makeLine({ vehicle, name }) {
  const box = make("input", { type: "checkbox", onchange: () => allow(vehicle, name, box.checked) });
  const words = make("span", {}, t("preflight.allow", { item: t(`preflight.item.${name}`), name: nameOf(vehicle) }));
  return make("li", {}, make("b", {}), make("span", {}), make("label", { class: "check" }, box, words));
}

function drawLine(row, item) {
  const [word, reason, box] = row.children;
  setAttribute(row, "data-level", item.state);
  setText(word, t(`preflight.${item.state}`));
  setText(reason, `${t(`preflight.item.${item.name}`)}: ${units.inUnits(item.reason)}`);
  setHidden(box, item.state !== "red");
  if (item.state !== "red") allowed[item.vehicle]?.delete(item.name); // red again later asks again
  box.firstChild.checked = allowed[item.vehicle]?.has(item.name) ?? false;
}

function allow(vehicle, item, on) {
  allowed[vehicle] ??= new Set();
  on ? allowed[vehicle].add(item) : allowed[vehicle].delete(item);
  refresh();
}

// Whether an error says that the station refused: anything else leaves open what it received.
const isNo = (error) => error.kind === "http" && error.status < 500;
const ASK_MS = 6_000; // longer than a command is fresh: asking starts nothing, whatever was done meanwhile
const ASKED_MS = 120_000;

async function start() {
  if (wrong()) { setText(status, wrong()); return; }
  clearTimeout(timer);
  turn++;
  go.disabled = true;
  again.disabled = true;
  setText(no, t("preflight.stop"));
  setText(status, t("preflight.starting"));
  const override = Object.fromEntries(Object.entries(allowed).map(([vehicle, items]) => [vehicle, [...items]]));
  const mine = { path: `/api/plans/${plan.id}/start`, body: { sortie: 1, vehicles: names, override, id: newId(), ...given() } };
  begun = mine;
  try {
    const answer = await post(mine.path, mine.body);
    if (begun !== mine) return;
    ended(true);
    started(answer);
  } catch (error) {
    if (begun !== mine) return;
    ended(!isNo(error));
    if (isNo(error)) {
      setText(status, t("preflight.refused", { why: error.message }));
      refresh();
    } else ask(mine, notice("bad", t("preflight.unknown")));
  }
}

function ended(close) {
  begun = null;
  again.disabled = false;
  setText(no, t("confirm.no"));
  if (close) dialog.close(); // the tiles are under it
}

function started(answer) {
  const times = Object.entries(answer?.takeoffs_in_s ?? {}).map(([vehicle, s]) => t("preflight.takeoff", { name: nameOf(vehicle), time: units.clock(s) }));
  notice("done", t("preflight.started", { list: times.join(", ") }));
}

// The same request again tells what became of it: the station answers an id that it knows as before, and one that it does
// not know comes too late to start anything.
async function ask({ path, body }, doubt) {
  if (body.given_clock_s == null && body.given_s == null) return; // without its time it would be taken for a new one
  const end = performance.now() + ASKED_MS;
  while (performance.now() < end) {
    await new Promise((done) => setTimeout(done, ASK_MS));
    try {
      const answer = await post(path, body);
      doubt.remove();
      started(answer);
      return;
    } catch (error) {
      if (!isNo(error)) continue;
      doubt.remove();
      notice("bad", t("preflight.refused", { why: error.message }));
      return;
    }
  }
}

// Cancel: before the start it closes; during it the station takes the start back, and pauses what had begun.
async function leave() {
  if (!begun) { dialog.close(); return; }
  const mine = begun;
  begun = null;
  setText(status, t("preflight.cancelling"));
  no.disabled = true;
  let word = null;
  try {
    const { results } = (await request("DELETE", mine.path, { id: mine.body.id })) ?? {};
    word = results?.length ? ["bad", t("preflight.paused", { list: results.map((row) => `${nameOf(row.vehicle)}: ${t(`outcome.${row.outcome}`)}`).join(", ") })] : ["done", t("preflight.cancelled")];
  } catch {
    word = ["bad", t("preflight.unknown")];
  }
  no.disabled = false;
  ended(true);
  notice(...word);
}
