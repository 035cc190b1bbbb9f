// Whether what the page shows is now: a word in the header, and a banner over everything once the daemon is silent.

import { make, setAttribute, setHidden, setText } from "/static/core/dom.js";
import { state, subscribe } from "/static/core/store.js";
import { t } from "/static/core/strings.js";
import { ageText } from "/static/core/units.js";

export function linkStatus() {
  const word = make("span", { class: "link", role: "status" });
  subscribe("link", "link to the daemon", () => {
    setText(word, state.link === "late" ? t("link.late", { age: ageText(state.silent_s) }) : t(`link.${state.link}`));
    setAttribute(word, "data-link", state.link);
  });
  return word;
}

export function linkBanner() {
  const text = make("span", {});
  const banner = make("div", { class: "banner", role: "alert", hidden: true }, text);
  subscribe("link problems", "banner", () => {
    setHidden(banner, state.link !== "lost");
    if (state.link === "lost") setText(text, state.problems.includes(t("app.token")) ? t("app.token") : t("link.banner", { age: ageText(Math.floor(state.silent_s)) }));
    setAttribute(document.documentElement, "data-link", state.link);
  });
  return banner;
}
