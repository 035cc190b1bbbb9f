"""Several people on one page: who may not command is told, one pilot has a vehicle, the log says who did what."""

import contextlib
import re

import pytest

from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.daemon_kit import GRID, serving
from tests.kit.mosaic_scene import EAST, NORTH
from tests.kit.page_kit import DESK, PHONE, TABLET, ok_for_all, opened, poll, send, standing, vehicle
from tests.page.test_command_bar import confirm

playwright = pytest.importorskip("playwright.sync_api")
LOCKED = "() => [...document.querySelectorAll('[data-locked=true]')].filter((e) => e.checkVisibility()).length"
NOBODY = {"id": -1, "name": "", "role": "viewer", "several": False, "invites": False}


def person(role, number=7, name="Anna"):
    return {"id": number, "name": name, "role": role, "several": role == "pilot", "invites": False}


@pytest.mark.parametrize("size", [DESK, TABLET, PHONE], ids=["desk", "tablet", "phone"])
def test_a_page_without_a_token_says_so_at_once_and_is_locked(browser, size):
    with standing(vehicle(1)) as station:
        ok_for_all(station)
        station.gets["/api/me"] = NOBODY
        with opened(browser, station.url, size) as page:
            page.wait_for_selector(".role-banner:has-text('This page can only look')")
            for verb in ("pause", "rtl", "land"):
                button = page.locator(f".command[data-verb={verb}]")
                assert button.get_attribute("aria-disabled") == "true"
                button.click(force=True)
            page.locator(".command[data-verb=land]").focus()
            page.keyboard.press("Enter")
            assert not page.locator(".confirm").is_visible()  # nobody is asked what cannot be done
            page.wait_for_selector(".notice:has-text('needs a role of pilot')")
            page.click(".tile")
            page.wait_for_selector(".details [data-verb=rtl]")
            page.click(".details [data-verb=rtl]", force=True)
            assert not page.locator(".confirm").is_visible() and station.heard == []
            station.gets["/api/me"] = person("operator", 0, "operator")
            page.evaluate("import('/static/core/news.js').then((news) => news.refresh())")  # a token was entered
            page.wait_for_selector(".role-banner", state="hidden")
            page.wait_for_function("() => !document.querySelector('[data-locked=true]')")
            page.click(".command[data-verb=pause]")
            confirm(page)
            page.wait_for_selector("[data-outcome=done]")


def test_who_is_not_let_in_is_told(browser):
    with standing() as station:
        station.gets["/api/me"] = NOBODY | {"role": None}
        with opened(browser, station.url) as page:
            page.wait_for_selector(".role-banner:has-text('neither to look nor to command')")


def test_every_lock_is_on_the_page(browser):
    """A button that has got another name would be open again."""
    with standing(vehicle(1)) as station:
        station.gets["/api/finds"] = [{"id": 1, "lat_deg": 47.4, "lon_deg": 8.5, "sigma_m": 1, "note": "boat"}]
        with opened(browser, station.url) as page:
            page.click("#tab-map")
            page.wait_for_selector(".finds li")
            counts = page.evaluate("""async () => {
              const { LOCKS } = await import("/static/people/me.js");
              return Object.values(LOCKS).flat().map((name) => [name, document.querySelectorAll(name).length]);
            }""")
            assert len(counts) > 5 and [name for name, count in counts if not count] == []


@pytest.mark.parametrize(("role", "open_ones"), [("viewer", 0), ("analyst", 1), ("pilot", 2)])
def test_each_role_has_its_buttons(browser, role, open_ones):
    with standing(vehicle(1)) as station:
        station.gets["/api/me"] = person(role)
        with opened(browser, station.url) as page:
            page.wait_for_selector(".me:has-text('Anna')")
            assert not page.locator(".role-banner").is_visible()  # who was invited knows it
            if open_ones < 2:
                page.wait_for_selector(".command[data-verb=rtl][aria-disabled=true]")
            page.click("#tab-map")
            if open_ones < 1:
                page.wait_for_selector("#panel-map [type=submit][aria-disabled=true]")
            else:
                assert page.locator("#panel-map [data-locked=true]").count() == 0
            assert (page.evaluate(LOCKED) == 0) == (open_ones == 2)


def test_one_operator_notices_nothing_of_it(browser):
    with standing(vehicle(1)) as station:
        station.gets["/api/holds"] = [{"vehicle": "v1", "pilot": {"id": 0, "name": "operator"}, "asked": None}]
        station.gets["/api/log"] = [
            {"time": "2026-05-04T10:20:30Z", "name": "operator", "role": "operator", "action": "rtl", "target": "v1",
             "outcome": "done", "reason": "", "count": 1},
        ]  # fmt: skip
        with opened(browser, station.url) as page:
            page.click(".tile")
            page.wait_for_timeout(300)
            assert not page.locator(".corner .holds").is_visible() and page.evaluate(LOCKED) == 0
            page.click("button[aria-label=People]")
            assert re.search("operator, operator: return v1: done", page.inner_text(".log li"))
            assert not page.locator(".people-dialog .holds").is_visible()
            assert "--lan" in page.inner_text(".people-dialog")


def test_a_vehicle_is_asked_for_and_handed_over(browser):
    with standing(vehicle(1), vehicle(2)) as station:
        station.answer = lambda method, path, body: (200, {"yours": False})
        station.gets["/api/me"] = person("pilot")
        mine = {"vehicle": "v1", "pilot": {"id": 7, "name": "Anna"}, "asked": {"id": 8, "name": "Ben"}}
        theirs = {"vehicle": "v2", "pilot": {"id": 8, "name": "Ben"}, "asked": None}
        station.gets["/api/holds"] = [mine, theirs]
        with opened(browser, station.url) as page:
            page.wait_for_selector(".corner .holds:has-text('Ben asks for v1')")
            page.click(".corner .holds >> text=Hand over")
            poll(page, lambda: station.heard == [("POST", "/api/holds/v1", {"act": "give"})])
            send(page, {"type": "holds", "rows": [{**mine, "pilot": mine["asked"], "asked": None}, theirs]})
            page.wait_for_selector(".corner .holds", state="hidden")
            page.click(".tile:has-text('v2')")
            page.click(".corner .holds:has-text('Ben has v2') >> text=Ask for it")
            poll(page, lambda: station.heard[-1] == ("POST", "/api/holds/v2", {"act": "take"}))
            send(page, {"type": "holds", "rows": [{**theirs, "asked": {"id": 7, "name": "Anna"}}]})
            page.wait_for_selector(".corner .holds:has-text('You have asked Ben for v2')")


@contextlib.contextmanager
def post(tmp_path):
    """A daemon for a command post, with two simulated vehicles."""
    lat, lon = (float(v) for v in GRID.to_geographic([EAST, NORTH]))
    with SimSwarm(make_swarm(2, home=(lat, lon, 500.0)), "tcpin:127.0.0.1:0", speed=2.0) as swarm:
        links = [text for address in swarm.addresses for text in ("--link", address)]
        with serving(tmp_path / "post", "--lan", "--bind", "127.0.0.1", *links) as served:
            served.until("/healthz", lambda row: row["status"] == "ok")
            yield served


def invited(page, name, role):
    """The link that the operator's page shows for somebody."""
    page.click("button[aria-label=People]")
    page.fill(".people-dialog input[type=text]", name)
    page.select_option(".people-dialog select", role)
    page.click(".people-dialog >> text='Invite' >> nth=-1")
    page.wait_for_selector(f".invitation:has-text('{name}') .qr")
    link = page.inner_text(".invitation code")
    page.click(".people-dialog >> text=Close")
    return link


def ordered(page, verb, vehicle, outcome):
    """Press a vehicle's command; it ends so. Gives the reason."""
    page.click(f".tile:has-text('{vehicle}')")
    page.click(f".details [data-verb={verb}]")
    confirm(page)
    row = f".outcomes [data-outcome={outcome}]:has-text('{vehicle}'):not(:has-text('from another page'))"
    reason = page.wait_for_selector(row).inner_text()
    with contextlib.suppress(playwright.TimeoutError):
        page.click("footer >> text=Dismiss", timeout=5_000)
    page.click(".details .close")
    return reason


def test_three_people_on_one_station(browser, tmp_path):
    options = {"fake": False, "ignore_https_errors": True}
    with post(tmp_path) as served, contextlib.ExitStack() as pages:

        def page_of(link):
            return pages.enter_context(opened(browser, link, **options))

        operator = page_of(f"{served.url}/#token={served.token}")
        operator.wait_for_selector(".tile:has-text('v2')")
        viewer = page_of(invited(operator, "Vera", "viewer"))
        link = invited(operator, "Paul", "pilot")
        pilot = page_of(link)
        viewer.wait_for_selector(".me:has-text('Vera, viewer')")
        viewer.wait_for_selector(".command[data-verb=pause][aria-disabled=true]")
        viewer.click(".command[data-verb=pause]", force=True)
        assert not viewer.locator(".confirm").is_visible()
        status = "fetch('/api/missions/v1/pause', { method: 'POST', body: '{}' }).then((answer) => answer.status)"
        assert viewer.evaluate(status) == 403  # what the page does not offer is refused as well

        pilot.wait_for_selector(".tile:has-text('v2')")
        assert "#" not in pilot.url and pilot.evaluate("document.cookie") == ""
        ordered(operator, "resume", "v1", "refused")  # nothing was paused; the operator has it all the same
        assert "operator has v1" in ordered(pilot, "resume", "v1", "refused")
        told = ordered(pilot, "pause", "v1", "refused")  # it stands on the ground, and says so itself
        assert "operator has v1" not in told

        pilot.click(".tile:has-text('v1')")
        pilot.click(".corner .holds >> text=Ask for it")
        operator.click(".corner .holds:has-text('Paul asks for v1') >> text=Hand over")
        pilot.wait_for_selector(".corner .holds", state="hidden")
        pilot.click(".details .close")
        assert "operator has" not in ordered(pilot, "resume", "v1", "refused")
        assert "Paul has v1" in ordered(operator, "resume", "v1", "refused")

        operator.click("button[aria-label=People]")
        operator.wait_for_selector(".log li:has-text('Paul, pilot: take v1: asked')")
        operator.wait_for_selector(".log li:has-text('operator, operator: hand over v1: done')")
        operator.click(".people li:has-text('Paul') >> text=Take back")
        pilot.wait_for_selector(".role-banner, .banner:not([hidden])")
        assert pilot.evaluate(status) == 401
        again = page_of(link)  # it was opened already
        again.wait_for_selector(".role-banner:has-text('opened already')")
