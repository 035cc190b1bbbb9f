"""A plan that was made with other settings than the form holds is said to be so, and goes to no vehicle."""

import contextlib

import pytest

from tests.kit.page_kit import TABLET, opened, poll, refused, saved, standing, vehicle

CORNERS = [[8.544, 47.397], [8.547, 47.397], [8.547, 47.399], [8.544, 47.399]]
AREA = "(c) => import('/static/plan/area.js').then((m) => m.change((rings) => rings.push(c)))"
PART = {"id": "v1", "length_m": 900.0, "time_s": 312, "photos": 40, "sorties": 1, "flights": [{"start_s": 0}]}
PLAN = {"id": "plan-1", "covered_share": 1.0, "makespan_s": 312, "spacing_m": 20, "vehicles": [PART]}
WRONG = ".plan-result .wrong"
OLDER = "The plan was made with other settings"


@contextlib.contextmanager
def planned(browser, **shared):
    """A page on which a plan for one vehicle was made at 80 m, and its station, which keeps what pages share."""
    kept = {"area": None, "settings": {}, "plan": None, "vehicles": {}, "version": 1} | shared

    def answer(method, path, body):
        if path == "/api/plan":
            kept.update(body, version=kept["version"] + 1)
            return 200, {"version": kept["version"]}
        return (201, PLAN) if path == "/api/plans" else (200, {"checks": []})

    with standing(vehicle(7)) as station:
        station.gets |= {"/api/plan": kept, "/api/plans": [PLAN], "/api/plans/plan-1/map": {"features": []}}
        station.answer = answer
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-plan")
            page.evaluate(AREA, CORNERS)
            page.fill("[name=vehicles]", "1")
            page.click("text=Make plan")
            page.wait_for_selector(".assignments select")
            page.select_option(".assignments select", "v7")
            assert page.inner_text(WRONG) == ""
            yield station, page


def test_a_plan_that_was_made_is_in_view(browser):
    with planned(browser) as (_, page):
        box = "document.querySelector('.plan-result .primary').getBoundingClientRect()"
        bar = "document.querySelector('.command-bar').getBoundingClientRect()"
        top = "document.querySelector('#panel-plan').scrollTop = 0"  # again each time: the first plan may still scroll
        page.wait_for_function(f"() => {{ {top}; return {box}.bottom > {bar}.top + 1; }}")
        page.locator("#panel-plan form").evaluate("(form) => form.requestSubmit()")
        page.wait_for_function(f"{box}.bottom <= {bar}.top + 1")


def test_a_plan_may_take_minutes(browser):
    with planned(browser) as (_, page):
        held = []
        page.route("**/api/plans", lambda route: held.append(route))
        page.clock.install()
        page.fill("[name=altitude_m]", "90")
        page.click("text=Make plan")
        poll(page, lambda: held)
        page.clock.fast_forward("05:00")
        page.wait_for_selector("button:has-text('Planning…')")
        assert page.locator(".notice:has-text('No plan was made')").count() == 0
        held[0].fulfill(json=PLAN, status=201)
        is_right(page)


def is_right(page):
    page.wait_for_function(f"document.querySelector('{WRONG}').textContent === ''")


@pytest.mark.parametrize(
    ("name", "group", "typed", "words"),
    [
        ("altitude_m", None, "120", "Height above takeoff, m: 80"),
        ("side_overlap", "Overlap", "70", "Side overlap, %: empty"),
        ("speed_m_s", "Speed, endurance, wait", "15", "Speed, m/s: empty"),
    ],
)
def test_a_setting_that_is_changed_after_the_plan_stops_its_upload_and_start(browser, name, group, typed, words):
    with planned(browser) as (station, page):
        if group:
            page.click(f"summary:has-text('{group}')")
        before = page.input_value(f"[name={name}]")
        page.fill(f"[name={name}]", typed)  # typed, not left yet
        page.wait_for_selector(f"{WRONG}:has-text('{OLDER} ({words})')")
        refused(page, OLDER)
        assert station.commands("upload") == []
        saved(page)
        with opened(browser, station.url, TABLET) as second:
            second.click("#tab-plan")
            second.wait_for_selector(f"{WRONG}:has-text('{OLDER} ({words})')")
        page.fill(f"[name={name}]", before)
        is_right(page)
        page.fill(f"[name={name}]", typed)
        page.click("text=Make plan")
        is_right(page)


def test_the_same_height_in_other_units_is_the_same_plan(browser):
    with planned(browser) as (_, page):
        page.click("button[aria-label=Settings]")
        page.select_option(".settings select >> nth=1", "us")
        page.click(".settings >> text=Close")
        assert page.input_value("[name=altitude_m]") == "262.5"
        assert page.inner_text(WRONG) == ""
        page.fill("[name=altitude_m]", "300")
        page.wait_for_selector(f"{WRONG}:has-text('Height above takeoff, ft: 262.5')")


def test_a_plan_of_an_older_page_is_not_called_old(browser):
    shared = {"area": {"type": "Polygon", "coordinates": [[*CORNERS, CORNERS[0]]]}, "plan": "plan-1"}
    with standing(vehicle(7)) as station:
        station.gets |= {"/api/plans": [PLAN], "/api/plans/plan-1/map": {"features": []}}
        station.gets["/api/plan"] = shared | {"settings": {"altitude_m": 60}, "vehicles": {"v1": "v7"}, "version": 3}
        with opened(browser, station.url, TABLET) as page:
            page.click("#tab-plan")
            page.wait_for_selector(".assignments select")
            assert page.inner_text(WRONG) == ""
