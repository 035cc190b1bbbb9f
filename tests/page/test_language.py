"""The page speaks the browser's language, or the one that was chosen, with that language's numbers."""

import math
import re

import pytest

from tests.kit.page_kit import DESK, PHONE, opened, poll, saved, standing, vehicle

axe = pytest.importorskip("axe_playwright_python.sync_playwright")
PART = re.compile(r"\{\w+(?:\|[^|}]*\|[^}]*)?\}")  # a value, or its singular and plural
GERMAN = {"locale": "de-DE"}
CATALOGUES = """async () => {
  const { english } = await import("/static/core/english.js");
  const { german } = await import("/static/core/german.js");
  return { english, german };
}"""
# Buttons whose words do not fit into them, or that reach over the edge of the page.
CUT = """(where) => [...document.querySelectorAll(where)].filter((e) => e.checkVisibility())
  .filter((e) => e.scrollWidth > e.clientWidth || e.scrollHeight > e.clientHeight
    || e.getBoundingClientRect().right > innerWidth)
  .map((e) => e.textContent)"""
SMALL_GAP = {
    "area_m2": 1234.0, "cause": "not flown", "confidence": 1, "lat_deg": 47.4, "lon_deg": 8.5, "polygon": None
}  # fmt: skip
COVERAGE = {
    "state": "in flight", "seen_share": 0.625, "poor_share": 0.125, "missed_share": 0.25, "planned_share": 0.0,
    "recorded": {"seen_share": 0.5}, "pictures": {"placed": 3, "recorded": 1}, "gaps": [SMALL_GAP],
    "missing_pictures": [],
}  # fmt: skip


def values(text: str) -> set[str]:
    """The names of the values that a text takes."""
    return set(re.findall(r"\{(\w+)[|}]", text))


def test_both_catalogues_have_the_same_keys_and_values(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        words = page.evaluate(CATALOGUES)
    english, german = words["english"], words["german"]
    assert sorted(german) == sorted(english)
    assert len(english) > 400
    assert {key for key in english if values(english[key]) != values(german[key])} == set()
    assert {key for key in english if bool(english[key]) != bool(german[key])} == set()
    assert [text for text in german.values() if text.count("{") != len(PART.findall(text))] == []


def test_a_german_browser_opens_the_page_in_german(browser):
    rows = [vehicle(1, name="Falke", speed_m_s=8.5), vehicle(2, battery=0.05)]
    with standing(*rows) as station, opened(browser, station.url, **GERMAN) as page:
        station.gets["/api/coverage"] = COVERAGE
        assert page.get_attribute("html", "lang") == "de"
        assert page.inner_text("#tab-fly") == "Flug"
        page.wait_for_selector(".tile:has-text('Falke') .speed:has-text('8,5 m/s')")
        assert re.fullmatch(r"vor \d,\d s", page.inner_text(".tile:has-text('Falke') .age"))
        page.wait_for_selector(".alarms:has-text('GEFAHR')")
        page.click(".command[data-verb=land]")
        assert page.inner_text("#confirm-question") == "Alle 2 Drohnen sofort landen, wo sie sind?"
        page.keyboard.press("Escape")
        page.click(".tile:has-text('Falke')")
        page.wait_for_selector(".details:has-text('47.397700, 8.546000')")  # coordinates keep their points
        page.click("#tab-map")
        assert page.get_attribute(".maplibregl-ctrl-zoom-in", "title") == "Vergrößern"
        page.evaluate("station.send({ type: 'coverage' })")
        page.wait_for_selector(".shares:has-text('62,5 %')")


def test_a_language_is_chosen_and_kept(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url) as page:
        assert page.get_attribute("html", "lang") == "en"
        for tongue, press, title in (("de", "Settings", "Einstellungen"), ("en", "Einstellungen", "Settings")):
            page.click(f"button[aria-label={press}]")
            page.select_option("select:has(option[value=de])", tongue)
            page.wait_for_selector(f"button[aria-label={title}]")
            page.wait_for_function("window.orthoswarm")
            assert page.get_attribute("html", "lang") == tongue


def test_other_languages_see_english_and_missing_words_are_english(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, locale="fr-FR") as page:
        assert page.get_attribute("html", "lang") == "en"
        assert page.inner_text("#tab-fly") == "Fly"
    with standing(vehicle(1)) as station:
        context = browser.new_context(**GERMAN)
        page = context.new_page()
        drop = "export const german = {};"
        page.route("**/german.js", lambda route: route.fulfill(body=drop, content_type="text/javascript"))
        page.goto(station.url)
        page.wait_for_selector("#tab-fly:has-text('Fly')")
        context.close()


def test_fields_show_and_take_german_numbers(browser):
    with standing(vehicle(1)) as station:
        settings = {"altitude_m": 62.5, "speed_m_s": "7.125", "wind_m_s": ""}
        shared = {"area": None, "settings": settings, "plan": None, "vehicles": {}, "version": 1}
        station.gets["/api/plan"] = shared
        station.answer = lambda method, path, body: (200, {"version": 2})
        with opened(browser, station.url, **GERMAN) as page:
            page.click("#tab-plan")
            poll(page, lambda: page.input_value("[name=altitude_m]") == "62,5")
            assert page.input_value("[name=speed_m_s]") == "7,125"
            page.fill("[name=altitude_m]", "71,5")
            page.locator("[name=altitude_m]").blur()
            saved(page)
            sent = station.heard[-1][2]["settings"]
            assert (sent["altitude_m"], sent["speed_m_s"]) == (71.5, "7.125")
            read = "(text) => import('/static/core/units.js').then((m) => m.numberOf(text))"
            assert page.evaluate(read, "1,250") == 1.25
            assert page.evaluate(read, "62,125") == 62.125
            assert math.isnan(page.evaluate(read, "1.250"))  # a thousand to some


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_german_words_fit_and_nothing_stands_in_the_way(browser, size):
    rows = [vehicle(1, name="Falke", battery=0.05), vehicle(2, silent_s=30)]
    with standing(*rows) as station, opened(browser, station.url, size, **GERMAN) as page:
        station.gets["/healthz"] = {"status": "ok", "problems": ["the disk is full"]}
        page.evaluate("station.send({ type: 'problem' })")
        page.wait_for_selector(".problems:has-text('1 Hinweis')")
        for mode in ("plan", "fly", "map"):
            page.click(f"#tab-{mode}")
            assert (
                page.evaluate(
                    CUT, ".commands button, header button, header .link, .under button, .panel button:not(.tile)"
                )
                == []
            )
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            report = axe.Axe().run(page)
            assert report.violations_count == 0, report.generate_report()
        page.click("#tab-fly")
        page.click(".tile:has-text('Falke')")
        page.wait_for_selector(".details:has-text('Falke')")
        assert page.evaluate(CUT, ".verbs button") == []
        page.click(".command[data-verb=rtl]")  # with three choices
        assert page.evaluate(CUT, ".confirm button") == []
        page.keyboard.press("Escape")
        page.click("button[aria-label=Einstellungen]")
        assert page.evaluate(CUT, ".settings button") == []
        assert axe.Axe().run(page).violations_count == 0


def test_a_finger_is_told_in_its_language_to_hold(browser):
    touch = {"has_touch": True, "is_mobile": True}
    with standing(vehicle(1)) as station, opened(browser, station.url, PHONE, **touch, **GERMAN) as page:
        page.tap(".command[data-verb=pause]")
        shown = "getComputedStyle(document.querySelector('.confirm-yes span'), '::after').content"
        assert page.evaluate(shown) == '" (1 s halten)"'
