// Dialogs over header, panel and map. The command bar stays in reach: pause, return and land are never covered, so that
// a dialog is not modal in the browser's sense; what it covers is inert instead.

import { make } from "/static/core/dom.js";

const COVERED = ["header", "#side", "#map"];
const cover = (on) => COVERED.forEach((name) => document.querySelector(name)?.toggleAttribute("inert", on));

export function dialogBox(attributes, ...children) {
  const box = make("dialog", { tabindex: "-1", ...attributes }, ...children);
  let before = null;
  const open = () => {
    before = document.activeElement;
    box.show();
    cover(true);
  };
  const close = () => {
    box.close();
    cover(false);
    before?.focus?.();
  };
  box.addEventListener("keydown", (event) => { if (event.key === "Escape") close(); });
  return { box, open, close };
}
