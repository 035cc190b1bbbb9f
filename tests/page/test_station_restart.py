"""After a restart of the station the page shows what the new run knows, and says what is of before."""

import contextlib

import pytest

from tests.kit.page_kit import TABLET, ok_for_all, opened, poll, send, standing, vehicle

GROUND = {"armed": False, "flight": {"state": "on ground", "text": "on ground", "item": 0, "items": 0}}
NEAR = "4.0 m from v9"
JOB = {"id": 7, "kind": "refine", "vehicle": "v2", "sortie": 1, "state": "running", "progress": 0.5, "message": ""}
PART = {"id": "v1", "length_m": 9, "time_s": 9, "photos": 1, "sorties": 1, "flights": []}
PLAN = {"id": "p1", "vehicles": [PART], "covered_share": 1, "makespan_s": 9, "warnings": [], "spacing_m": 9}
OUTLINE = [[8.544, 47.396], [8.547, 47.396], [8.547, 47.399], [8.544, 47.396]]
SHARED = {"area": {"type": "Polygon", "coordinates": [OUTLINE]}, "settings": {}, "plan": "p1", "vehicles": {"v1": "v1"}}


@contextlib.contextmanager
def restarted(browser, *rows, **gets):
    """A page with vehicles 1 (in the air) and 2 and 3 (on the ground) after its station came back with other rows."""
    with standing(vehicle(1, alarm=NEAR), vehicle(2, **GROUND), vehicle(3, **GROUND)) as station:
        station.gets |= {"/api/jobs": [JOB], "/api/plan": SHARED | {"version": 4}, "/api/plans": [PLAN]}
        station.gets["/api/plans/p1/map"] = {"features": []}
        with opened(browser, station.url, TABLET) as page:
            page.wait_for_selector(".tile >> nth=2")
            page.wait_for_selector(f".alarms:has-text('{NEAR}')")
            page.wait_for_selector(".jobs li", state="attached")
            page.wait_for_selector(".plan-result .assignments li", state="attached")
            empty = {"area": None, "settings": {}, "plan": None, "vehicles": {}, "version": 0}
            station.gets |= {"/api/vehicles": list(rows), "/api/jobs": [], "/api/plan": empty, "/api/plans": []} | gets
            page.evaluate("for (const socket of [...station.sockets]) socket.close();")
            yield station, page


def test_what_the_new_run_does_not_know_goes(browser):
    with restarted(browser, vehicle(1), vehicle(3, **GROUND)) as (_, page):
        page.wait_for_selector(".tiles li[data-id=v2]", state="detached")
        page.wait_for_function("document.querySelectorAll('button.vehicle').length === 2")
        page.wait_for_selector(".jobs li", state="detached")
        page.wait_for_selector(".plan-result", state="hidden")
        page.wait_for_function("() => import('/static/plan/area.js').then((m) => m.area.rings.length === 0)")
        page.wait_for_function("document.querySelectorAll('.tile').length === 2")
        page.wait_for_selector(".alarms", state="hidden")


@pytest.mark.parametrize("sent", [True, False], ids=["had sent pictures", "had sent none"])
def test_one_in_the_air_stays_as_lost_until_it_is_heard_again(browser, sent):
    pictures = {"id": "v1", "state": "pictures", "sortie": 1, "frames": {"frames": 18}, "name": ""}
    with restarted(browser, *([pictures] if sent else []), vehicle(3, **GROUND)) as (station, page):
        page.wait_for_selector(".tiles li[data-id=v2]", state="detached")
        tile = ".tiles li[data-id=v1]"
        page.wait_for_selector(f"{tile} .why:has-text('not heard since the ground station was started again')")
        page.wait_for_selector(f"{tile} .tile[data-level=bad]")
        page.wait_for_selector(".alarms:has-text('v1: not heard since the ground station was started again')")
        assert page.locator(f".alarms:has-text('{NEAR}')").count() == 0
        ok_for_all(station)
        page.click(".command[data-verb=rtl]")
        page.wait_for_selector(".confirm:has-text('Return 1 vehicle')")
        page.keyboard.press("Escape")
        station.gets["/api/vehicles"] = [vehicle(1), vehicle(3, **GROUND)]
        send(page, {"type": "vehicle_event", "vehicle": "v1", "kind": "found"})
        poll(page, lambda: page.inner_text(f"{tile} .why") == "")
        page.wait_for_selector(".alarms", state="hidden")


def test_a_vehicle_heard_while_the_list_is_on_its_way_stays(browser):
    with standing(vehicle(1)) as station, opened(browser, station.url, TABLET) as page:
        page.wait_for_selector(".tile")
        held = []
        page.route("**/api/vehicles", lambda route: held.append(route))
        send(page, {"type": "vehicle_event", "vehicle": "v1", "kind": "found"})
        poll(page, lambda: held)
        send(page, {"type": "vehicle"} | vehicle(2, **GROUND))
        page.wait_for_selector(".tiles li[data-id=v2]")
        held[0].fulfill(json=[vehicle(1)])
        page.unroute_all(behavior="ignoreErrors")
        page.wait_for_timeout(700)  # rows are gathered for a tenth of a second
        assert page.locator(".tiles li[data-id=v2]").count() == 1
