"""Routes of a command post: who am I, invitations and sessions, who has which vehicle, who did what."""

import asyncio
from typing import Final

import segno
from fastapi import HTTPException, Query, Request, Response

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.store.people_rows import Deed, Role
from gcs_plugin.web.answers import JsonAnswer, json_body
from gcs_plugin.web.guard import Access, act_of, session_cookie

_SESSION_S: Final = 30 * 24 * 3600
"""An operation takes days to weeks; whoever stays longer is invited again."""


class PeopleRoutes:
    """The routes' functions; those that touch the disk run in threads.

    Args:
        daemon: whose people they are. access: how they reach it. address: of the page, for invitations.
    """

    def __init__(self, daemon: Daemon, access: Access, address: str) -> None:
        self._people, self._pilots, self._fleet = daemon.people, daemon.pilots, daemon.links.fleet
        self._access, self._address = access, address

    async def me(self, request: Request) -> Response:
        """Who asks: `id`, `name`, `role` (null: nobody), whether there are `several` pilots, and `invites` people."""
        person = act_of(request.scope).person
        role = None if person.role is Role.ANYBODY else person.role.word
        several = self._people.has_several_pilots
        own = {"id": person.id, "name": person.name, "role": role}
        return JsonAnswer(own | {"several": several, "invites": self._access.lan and person.role is Role.OPERATOR})

    async def join(self, request: Request) -> Response:
        """Exchange an invitation ({"invitation": SECRET}) for a session's cookie, once."""
        body = await json_body(request)
        joined = await asyncio.to_thread(self._people.join, body.get("invitation")) if self._access.lan else None
        if joined is None:
            raise HTTPException(
                403,
                "this invitation is void: it was opened already, taken back, or is older than a day; ask for another",
            )
        person, secret = joined
        self._people.note(person, [Deed("join", "", "done")])
        answer = JsonAnswer({"id": person.id, "name": person.name, "role": person.role.word})
        answer.set_cookie(
            session_cookie(request.scope), secret, max_age=_SESSION_S, secure=True, httponly=True, samesite="strict"
        )
        return answer

    async def invite(self, request: Request) -> Response:
        """Invite somebody ({"name": N, "role": viewer, analyst or pilot}). Answers `link`, good once and for a day.

        `qr` is the link as rows of 0 and 1.
        """
        if not self._access.lan:
            raise HTTPException(409, "only this machine reaches the daemon; start it with --lan to invite people")
        body = await json_body(request)
        number, secret = await asyncio.to_thread(self._people.invite, body.get("name"), body.get("role"))
        link = f"{self._address}#invitation={secret}"
        act_of(request.scope).deeds = [Deed("invite", f"{body['name']} ({body['role']})", "done")]
        rows = ["".join(map(str, row)) for row in segno.make(link, micro=False).matrix]
        return JsonAnswer({"id": number, "link": link, "qr": rows}, status_code=201)

    def people(self) -> Response:
        """Everybody invited: `id`, `name`, `role`, `state` (invited, expired, joined, revoked), `here`."""
        return JsonAnswer(self._people.rows())

    def revoke(self, number: int) -> Response:
        """Take an invitation and its session back, at once."""
        if not self._people.revoke(number):
            raise HTTPException(404, "there is no such person, or not any more; see /api/people")
        return Response(status_code=204)

    async def holds(self) -> Response:
        """Which pilot has which vehicle, and who has asked for it: `vehicle`, `pilot`, `asked`."""
        return JsonAnswer(self._pilots.rows())

    async def hold(self, vehicle: str, request: Request) -> Response:
        """Take a vehicle ({"act": "take"}), or ask its pilot for it; its pilot can `give` it, `keep` it or `free` it.

        Answers whether it is `yours` now.
        """
        act, body = act_of(request.scope), await json_body(request)
        wanted = str(body.get("act"))
        vehicle = self._fleet.names.name_of(self._fleet.system_of(vehicle))
        yours = self._pilots.change(act.person, vehicle, wanted)
        act.deeds = [Deed(wanted, vehicle, "done" if yours or wanted != "take" else "asked")]
        return JsonAnswer({"vehicle": vehicle, "yours": yours})

    def log(self, limit: int = Query(500, ge=0, le=100_000)) -> Response:
        """Who did what when, newest first: `time`, `name`, `role`, `action`, `target`, `outcome`, `reason`, `count`."""
        return JsonAnswer(self._people.log(limit))
