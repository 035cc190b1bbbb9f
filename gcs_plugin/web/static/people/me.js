// Who this page is to the station: said at once where it may not command, and what it may not press is locked.

import { joinProblem } from "/static/core/api.js";
import { make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { notice } from "/static/core/notices.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";

const RANK = { viewer: 1, analyst: 2, pilot: 3, operator: 4 };
// What needs which role, the most first. A test finds each on the page.
export const LOCKS = {
  pilot: [".command", ".details [data-verb]", ".plan-result .row button"],
  analyst: ["#panel-plan button", "#panel-map button[type=submit]", "section:has(> .finds) > .row button", ".finds .close", ".details .verbs:not([role]) > button:last-child", "section:has(> .jobs) > button", ".coverage > button"],
};

// Until the station has said who this is, nothing is locked: it refuses what is not allowed.
export const may = (role) => !state.me || (RANK[state.me.role] ?? 0) >= RANK[role];
const missing = (element) => Object.keys(LOCKS).find((role) => element.closest(LOCKS[role].join())) ?? null;

function lock() {
  for (const element of document.querySelectorAll(Object.values(LOCKS).flat().join())) {
    const role = missing(element);
    const locked = !may(role);
    if (locked === (element.dataset.locked === "true")) continue;
    element.dataset.locked = locked;
    setAttribute(element, "aria-disabled", locked ? "true" : null);
    element.title = locked ? t("people.locked", { role: t(`role.${role}`) }) : "";
  }
}

for (const kind of ["click", "submit"]) {
  document.addEventListener(kind, (event) => {
    const role = missing(event.submitter ?? event.target);
    if (!role || may(role)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    notice("warn", t("people.locked", { role: t(`role.${role}`) }));
  }, true);
}

export function roleBanner() {
  const banner = make("div", { class: "role-banner", role: "alert", hidden: true });
  subscribe("me link", "role", () => {
    const nobody = state.me?.id === -1;
    setHidden(banner, !nobody || state.link === "lost");
    setText(banner, joinProblem || t(state.me?.role ? "people.look" : "people.out"));
    setAttribute(document.documentElement, "data-may", state.me ? state.me.role ?? "nobody" : null);
  });
  subscribe("me tick ready", "locks", () => { if (!may("pilot") || document.querySelector("[data-locked=true]")) lock(); });
  return banner;
}
