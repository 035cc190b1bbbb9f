// The confirmation of what moves vehicles: a mouse or a key presses once; a finger holds for one second. The question opens
// on Cancel, and a key that was down then confirms nothing until it was let go: holding Enter must not land the swarm.
// A hold is of one finger, for one question, and counted in steps between which the page hears that the finger was lifted:
// neither a second finger, nor a question that took the first one's place, nor a page that was busy makes a tap a hold.

import { button, make, setHidden, setText } from "/static/core/dom.js";
import { t } from "/static/core/strings.js";

const STEP_MS = 250;
const STEPS = 4; // one second; the bar in layout.css fills in the same time
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
  const fingers = new Set(); // pointers on the button
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
  const hold = (left) => { timer = setTimeout(() => (left > 1 ? hold(left - 1) : confirm()), STEP_MS); };
  yes.addEventListener("pointerdown", (event) => {
    touch = event.pointerType === "touch" || event.pointerType === "pen";
    if (!touch) return;
    stop();
    fingers.add(event.pointerId);
    yes.setPointerCapture(event.pointerId);
    if (fingers.size > 1) return;
    yes.classList.add("holding");
    hold(STEPS);
  });
  for (const kind of ["pointerup", "pointercancel"]) yes.addEventListener(kind, (event) => { fingers.delete(event.pointerId); stop(); });
  document.addEventListener("visibilitychange", stop);
  yes.addEventListener("contextmenu", (event) => event.preventDefault());
  yes.addEventListener("click", (event) => {
    const tapped = touch && event.detail > 0;
    touch = false;
    if (!tapped && performance.now() - opened > SETTLE_MS) confirm();
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
    stop();
    fingers.clear();
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
