// Theme, units, coordinates, language, sound and the token.

import { setToken, token } from "/static/core/api.js";
import { dialogBox } from "/static/core/dialog.js";
import { button, choice, labelled, make } from "/static/core/dom.js";
import { setSetting, settings } from "/static/core/settings.js";
import { LANGUAGES, t } from "/static/core/strings.js";

const CHOICES = { theme: ["dark", "sunlight"], units: ["metric", "us"], coordinates: ["decimal", "dms", "utm", "mgrs"], language: ["auto", ...LANGUAGES] };
const HINTS = { language: "settings.language.hint" };

// Words are written once, when a part is made: in another language the page starts anew.
function choose(name, value) {
  setSetting(name, value);
  if (name === "language") location.reload();
}

export function settingsDialog(onToken) {
  const secret = make("input", { type: "password", autocomplete: "off", value: token() });
  const flag = (name) => { const on = make("input", { type: "checkbox", checked: settings[name], onchange: () => setSetting(name, on.checked) }); return make("label", { class: "check" }, on, make("span", {}, t(`settings.${name}`))); };
  const dialog = dialogBox({ class: "settings", "aria-labelledby": "settings-title" }, make("h2", { id: "settings-title" }, t("settings.title")),
    ...Object.entries(CHOICES).map(([name, values]) => labelled(t(`settings.${name}`), choice(values.map((value) => [value, t(`settings.${name}.${value}`)]), settings[name], (value) => choose(name, value)), HINTS[name] && t(HINTS[name]))),
    flag("sound"), flag("speak"),
    labelled(t("settings.token"), secret, t("settings.token.hint")),
    make("div", { class: "row wrap" }, button(t("settings.close"), () => dialog.close(), { class: "primary" })));
  secret.onchange = () => { setToken(secret.value); onToken(); };
  return dialog;
}
