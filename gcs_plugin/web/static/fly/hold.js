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

// A button of the question: one press of a mouse or a key, or a hold of a finger, carries out what it offers.
function choice(css, settled, carryOut) {
  const element = make("button", { type: "button", class: css, "aria-describedby": "confirm-question" }, make("span", { dataset: { hold: ` ${t("confirm.hold")}` } }), make("i", { "aria-hidden": "true" }));
  const fingers = new Set(); // pointers on the button
  let work = null;
  let touch = false;
  let timer = null;
  const stop = () => { clearTimeout(timer); timer = null; element.classList.remove("holding"); };
  const go = () => { if (work) carryOut(work); };
  const hold = (left) => { timer = setTimeout(() => (left > 1 ? hold(left - 1) : go()), STEP_MS); };
  element.addEventListener("pointerdown", (event) => {
    touch = event.pointerType === "touch" || event.pointerType === "pen";
    if (!touch) return;
    stop();
    fingers.add(event.pointerId);
    element.setPointerCapture(event.pointerId);
    if (fingers.size > 1) return;
    element.classList.add("holding");
    hold(STEPS);
  });
  for (const kind of ["pointerup", "pointercancel"]) element.addEventListener(kind, (event) => { fingers.delete(event.pointerId); stop(); });
  document.addEventListener("visibilitychange", stop);
  element.addEventListener("contextmenu", (event) => event.preventDefault());
  element.addEventListener("click", (event) => {
    const tapped = touch && event.detail > 0;
    touch = false;
    if (!tapped && settled()) go();
  });
  // Offer something else: {label, tone, work}; nothing hides the button.
  const offer = (what) => {
    stop();
    fingers.clear();
    work = what?.work ?? null;
    setHidden(element, !work);
    setText(element.firstChild, what?.label ?? "");
    element.dataset.tone = what?.tone ?? "";
  };
  return { element, stop, offer };
}

export function holdConfirm() {
  let opened = 0;
  let before = null;
  let held = new Set(); // keys that were down when the question opened, and are since
  const settled = () => performance.now() - opened > SETTLE_MS;
  const carryOut = (work) => { close(); work(); };
  const question = make("p", { id: "confirm-question" });
  const [yes, other] = [choice("confirm-yes", settled, carryOut), choice("confirm-other", settled, carryOut)];
  const no = button(t("confirm.no"), () => close(), { class: "confirm-no" });
  const box = make("div", { class: "confirm", role: "alertdialog", "aria-labelledby": "confirm-question", hidden: true }, question, make("div", { class: "row wrap" }, yes.element, other.element, no));
  function close() {
    for (const one of [yes, other]) one.offer(null);
    setHidden(box, true);
    before?.focus?.();
  }
  document.addEventListener("keyup", (event) => held.delete(event.code), true);
  box.addEventListener("keydown", (event) => {
    if (event.key === "Escape") close();
    else if (PRESSES.has(event.code) && (event.repeat || held.has(event.code))) event.preventDefault();
    else if (["Tab", "ArrowLeft", "ArrowRight"].includes(event.key)) {
      event.preventDefault();
      const all = [yes.element, other.element, no].filter((element) => !element.hidden);
      const step = event.key === "ArrowLeft" || (event.key === "Tab" && event.shiftKey) ? all.length - 1 : 1;
      all[(all.indexOf(document.activeElement) + step) % all.length].focus();
    }
  });
  // Ask; the work of what is chosen runs once it is confirmed. `also`: a second choice of the same kind.
  const ask = (text, label, tone, work, also = null) => {
    setText(question, text);
    yes.offer({ label, tone, work });
    other.offer(also);
    opened = performance.now();
    held = new Set(down);
    before = document.activeElement;
    setHidden(box, false);
    no.focus();
  };
  return { box, ask };
}
