"""Alarms: what gets worse is said again, Seen is for what is on the screen, and a second page raises the same."""

from tests.kit.page_kit import opened, send, standing, vehicle

SOUNDS = """() => {
  window.beeps = 0;
  AudioContext.prototype.createOscillator = () => { window.beeps++; throw new Error("silent"); };
}"""


def texts(page) -> list[str]:
    return page.locator(".alarms:visible li").all_inner_texts()


def seen(page):
    page.wait_for_timeout(400)  # what came up just before the press was not read
    page.click(".alarms >> text=Seen")


def change(page, **what):
    send(page, {"type": "vehicle", "id": "v1", "system": 1} | what)


def test_an_alarm_that_was_seen_and_gets_worse_is_an_alarm_again(browser):
    with standing(vehicle(1, battery=0.22)) as station, opened(browser, station.url) as page:
        page.evaluate(SOUNDS)
        page.wait_for_selector(".alarms:has-text('WATCH v1: battery low')")
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
        page.wait_for_timeout(800)
        before = page.evaluate("beeps")
        change(page, battery=0.08)
        page.wait_for_selector(".alarms:has-text('DANGER v1: battery 8 %: land now')")
        page.wait_for_timeout(300)
        assert page.evaluate("beeps") > before
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
        change(page, battery=0.07)  # no new level: it was seen
        page.wait_for_selector(".tile .why:has-text('7 %')")
        page.wait_for_timeout(300)
        assert texts(page) == []


def test_seen_is_for_the_alarms_that_are_listed(browser):
    rows = [vehicle(k, battery=0.1) for k in range(1, 10)]
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".alarms:has-text('and 4 more')")
        first = texts(page)
        assert len(first) == 5
        seen(page)
        page.wait_for_function("() => document.querySelectorAll('.alarms li').length === 4")
        assert not set(first) & set(texts(page))
        assert "more" not in page.inner_text(".alarms")
        seen(page)
        page.wait_for_selector(".alarms", state="hidden")
