"""Vehicles without a link: whether their pictures come now, came earlier, or have not come yet."""

from datetime import datetime, timedelta

from tests.kit.page_kit import opened, send, standing


def sender(number, came_s=None, frames=0):
    row = {"id": f"v{number}", "name": "", "state": "pictures", "sortie": 1, "frames": {"frames": frames}}
    return row | ({} if came_s is None else {"came_s": came_s})


def test_pictures_of_an_earlier_flight_are_not_said_to_come_now(browser):
    days_400_s = 400 * 86400.0
    with (
        standing(sender(1, 0.0, 3), sender(2, days_400_s, 3), sender(3)) as station,
        opened(browser, station.url) as page,
    ):
        page.wait_for_selector(".tile >> nth=2")
        year = str((datetime.now().astimezone() - timedelta(days=400)).year)
        page.wait_for_selector(f".tile:has-text('v2') .word:has-text('last picture {year}-')")
        page.wait_for_selector(".tile:has-text('v3') .word:has-text('no pictures yet')")
        send(page, {"type": "vehicle", **sender(2, 0.0, 4)})
        page.wait_for_selector(".tile:has-text('v2') .word:has-text('sends pictures only')")
