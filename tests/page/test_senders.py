"""Vehicles without a link: whether their pictures come now, came earlier, or have not come yet."""

from datetime import UTC, datetime, timedelta

from tests.kit.page_kit import opened, send, standing


def sender(number, came=None, frames=0):
    row = {"id": f"v{number}", "name": "", "state": "pictures", "sortie": 1, "frames": {"frames": frames}}
    return row | ({"last_arrived": came.isoformat()} if came else {})


def test_pictures_of_an_earlier_flight_are_not_said_to_come_now(browser):
    now = datetime.now(UTC)
    soon = now + timedelta(hours=1)  # a slow machine must not let it grow old
    rows = [sender(1, soon, 3), sender(2, now - timedelta(days=400), 3), sender(3)]
    with standing(*rows) as station, opened(browser, station.url) as page:
        page.wait_for_selector(".tile >> nth=2")
        words = page.locator(".tile .word").all_inner_texts()
        day = (now - timedelta(days=400)).astimezone().strftime("%Y-%m-%d %H:%M")
        assert words == ["sends pictures only", f"last picture {day}", "no pictures yet"]
        send(page, {"type": "vehicle", **sender(2, soon, 4)})
        page.wait_for_selector(".tile:has-text('v2') .word:has-text('sends pictures only')")
