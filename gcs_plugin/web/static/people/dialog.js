// Who is here: this page's person, invitations, who has which vehicle, and who did what.

import { get, request } from "/static/core/api.js";
import { timeOfDay } from "/static/core/clock.js";
import { dialogBox } from "/static/core/dialog.js";
import { button, choice, keyedList, labelled, make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { holdList } from "/static/people/holds.js";

const ROLES = ["viewer", "analyst", "pilot"];
const ROWS = 100; // of the log
const SVG = "http://www.w3.org/2000/svg";
const QUIET = 4; // light modules that a code needs around it

// Rows of 0 and 1 as a picture.
function code(rows) {
  const [svg, path] = ["svg", "path"].map((name) => document.createElementNS(SVG, name));
  const size = rows.length + 2 * QUIET;
  for (const [name, value] of [["viewBox", `0 0 ${size} ${size}`], ["role", "img"], ["aria-label", t("people.qr")], ["class", "qr"]]) svg.setAttribute(name, value);
  path.setAttribute("d", rows.flatMap((row, y) => [...row].map((dark, x) => (dark === "1" ? `M${x + QUIET} ${y + QUIET}h1v1h-1z` : ""))).join(""));
  svg.append(path);
  return svg;
}

const fail = (error) => notice("bad", t("people.failed", { why: error.message }));

function invitations(reload) {
  const name = make("input", { type: "text", maxlength: 60, required: true, autocomplete: "off" });
  let role = "viewer";
  const shown = make("div", { class: "invitation", role: "status" });
  const list = make("ul", { class: "people" });
  const nobody = make("p", { class: "quiet" }, t("people.none"));
  const form = make("form", { onsubmit: invite }, labelled(t("people.name"), name), labelled(t("people.role"), choice(ROLES.map((key) => [key, t(`role.${key}.about`)]), role, (value) => { role = value; })), make("button", { type: "submit", class: "primary" }, t("people.invite")));
  async function invite(event) {
    event.preventDefault();
    try {
      const { link, qr } = await request("POST", "/api/people", { name: name.value.trim(), role });
      const copy = button(t("people.copy"), () => navigator.clipboard.writeText(link).then(() => setText(copy, t("people.copied")), () => setText(copy, t("people.uncopied"))), { class: "small" });
      shown.replaceChildren(make("p", {}, t("people.link", { name: name.value.trim() })), code(qr), make("code", {}, link), copy);
      name.value = "";
      reload();
    } catch (error) { fail(error); }
  }
  const draw = keyedList(list, (row) => make("li", {}, make("span", {}), button(t("people.revoke"), () => request("DELETE", `/api/people/${row.id}`).then(() => { shown.replaceChildren(); reload(); }, fail), { class: "small" })), (item, row) => {
    setText(item.firstChild, `${row.name}, ${t(`role.${row.role}`)}: ${t(`people.state.${row.state === "joined" && row.here ? "here" : row.state}`)}`);
    setHidden(item.lastChild, row.state === "revoked");
  });
  const show = (rows) => { draw(rows.map((row) => [row.id, row])); setHidden(nobody, rows.length > 0); };
  return { box: make("section", {}, make("h3", {}, t("people.invite")), form, shown, nobody, list), show };
}

export function peopleDialog() {
  const you = make("p", {});
  const alone = make("p", { class: "quiet" }, t("people.lan"));
  const invited = invitations(() => reload());
  const log = make("ol", { class: "log", tabindex: "0", "aria-label": t("log.title") });
  const nothing = make("p", { class: "quiet" }, t("log.none"));
  const dialog = dialogBox({ class: "people-dialog", "aria-labelledby": "people-title" }, make("h2", { id: "people-title" }, t("people.title")), you, holdList(), invited.box, alone,
    make("section", {}, make("h3", {}, t("log.title")), nothing, log), make("div", { class: "row wrap" }, button(t("people.close"), () => dialog.close(), { class: "primary" })));
  const draw = keyedList(log, () => make("li", {}), (item, row) => {
    const first = t("log.row", { ...row, action: t(`log.act.${row.action}`), time: timeOfDay(Date.parse(row.time), { seconds: true }), role: t(`role.${row.role}`) }).trim();
    setText(item, [`${first}: ${t(`log.outcome.${row.outcome}`)}`, row.count > 1 && t("log.count", row), row.reason].filter(Boolean).join(" "));
    setAttribute(item, "data-outcome", row.outcome);
  });
  async function reload() {
    if (!dialog.box.open) return;
    try {
      const [rows, people] = await Promise.all([get(`/api/log?limit=${ROWS}`), state.me?.invites ? get("/api/people") : []]);
      log.replaceChildren();
      draw([]);
      draw(rows.map((row, k) => [`${k}`, row]));
      setHidden(nothing, rows.length > 0);
      invited.show(people);
    } catch (error) { if (error.kind === "http") fail(error); }
  }
  subscribe("me people", "people", () => {
    const { name, role, invites, id } = state.me ?? {};
    setText(you, id === -1 ? t("people.you.look") : role === "operator" ? t("people.you.operator") : t("people.you", { name, role: t(`role.${role}`) }));
    setHidden(invited.box, !invites);
    setHidden(alone, invites || role !== "operator");
    reload();
  });
  const open = () => { dialog.open(); reload(); };
  return { box: dialog.box, open };
}

export function peopleButton(open) {
  const word = make("span", { class: "me" });
  subscribe("me", "person", () => setText(word, state.me?.id > 0 ? `${state.me.name}, ${t(`role.${state.me.role}`)}` : ""));
  return make("button", { type: "button", class: "people-button", "aria-label": t("people.title"), onclick: open }, make("span", { "aria-hidden": "true" }, "☺"), word);
}
