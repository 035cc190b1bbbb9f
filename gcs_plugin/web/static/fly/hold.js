// The confirmation of what moves vehicles: a mouse or a key presses once; a finger holds for one second. The question opens
// on Cancel, and a key that was down then confirms nothing until it was let go: holding Enter must not land the swarm.

import { button, make, setHidden, setText } from "/static/core/dom.js";
import { t } from "/static/core/strings.js";

const HOLD_MS = 1000;
const SETTLE_MS = 350; // a double press of the first button is not a confirmation

const PRESSES = new Set(["Enter", "NumpadEnter", "Space"]);
const down = new Set(); // keys that are held now

document.addEventListener("keydown", (event) => {
  down.add(event.code);
  if (event.repeat && PRESSES.has(event.code) && event.target.closest?.("button")) event.preventDefault(); // a held key presses a button once
}, true);
document.addEventListener("keyup", (event) => down.delete(event.code), true);
window.addEventListener("blur", () => down.clear());

export function holdConfirm() {
  const question = make("p", { id: "confirm-question" });
  const yes = make("button", { type: "button", class: "confirm-yes", "aria-describedby": "confirm-question" }, make("span", {}), make("i", { "aria-hidden": "true" }));
  const no = button(t("confirm.no"), () => close(), { class: "confirm-no" });
  const box = make("div", { class: "confirm", role: "alertdialog", "aria-labelledby": "confirm-question", hidden: true }, question, make("div", { class: "row" }, yes, no));
  let go = null;
  let opened = 0;
  let touch = false;
  let timer = null;
  let before = null;
  let held = new Set(); // keys that were down when the question opened, and are since
  function close() {
    go = null;
    stop();
    setHidden(box, true);
    before?.focus?.();
  }
  function confirm() {
    const work = go;
    if (!work) return;
    close();
    work();
  }
  function stop() {
    clearTimeout(timer);
    timer = null;
    yes.classList.remove("holding");
  }
  yes.addEventListener("pointerdown", (event) => {
    touch = event.pointerType === "touch" || event.pointerType === "pen";
    if (!touch) return;
    yes.setPointerCapture(event.pointerId);
    yes.classList.add("holding");
    timer = setTimeout(confirm, HOLD_MS);
  });
  for (const kind of ["pointerup", "pointercancel"]) yes.addEventListener(kind, stop);
  yes.addEventListener("contextmenu", (event) => event.preventDefault());
  yes.addEventListener("click", (event) => {
    const finger = touch && event.detail > 0;
    touch = false;
    if (!finger && performance.now() - opened > SETTLE_MS) confirm();
  });
  document.addEventListener("keyup", (event) => held.delete(event.code), true);
  box.addEventListener("keydown", (event) => {
    if (event.key === "Escape") close();
    else if (PRESSES.has(event.code) && (event.repeat || held.has(event.code))) event.preventDefault();
    else if (["Tab", "ArrowLeft", "ArrowRight"].includes(event.key)) {
      event.preventDefault();
      (document.activeElement === yes ? no : yes).focus();
    }
  });
  // Ask; work() runs once it is confirmed.
  const ask = (text, label, tone, work) => {
    setText(question, text);
    setText(yes.firstChild, label);
    yes.dataset.tone = tone;
    go = work;
    opened = performance.now();
    held = new Set(down);
    before = document.activeElement;
    setHidden(box, false);
    no.focus();
  };
  return { box, ask };
}
