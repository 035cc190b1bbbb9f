// Words of a command post: who is here, who has which vehicle, who did what.

export const peopleWords = {
  "people.title": "People", "people.close": "Close", "people.you": "You are {name}, {role}.", "people.you.operator": "You are the operator: you can do everything, and invite others.",
  "people.you.look": "This page has no token and no invitation: it can look, nothing else.",
  "people.look": "This page can only look: no command leaves it. Open the link that the ground station printed, or an invitation, or enter the token in Settings.",
  "people.out": "This page is let in neither to look nor to command. Open the link that the ground station printed, or an invitation, or enter the token in Settings.",
  "people.locked": "This needs a role of {role}. Ask the operator for an invitation.",
  "role.viewer": "viewer", "role.analyst": "analyst", "role.pilot": "pilot", "role.operator": "operator",
  "role.viewer.about": "Viewer: looks", "role.analyst.about": "Analyst: also plans, finds, exports", "role.pilot.about": "Pilot: also commands vehicles",
  "people.invite": "Invite", "people.name": "Name", "people.role": "Role", "people.link": "Show this code to {name}, or send the link. It opens once, within a day.", "people.copy": "Copy link", "people.copied": "Copied", "people.uncopied": "Not copied: mark the link and copy it",
  "people.qr": "Code of the invitation", "people.lan": "Others can join if the ground station is started with --lan.", "people.none": "Nobody was invited yet.",
  "people.state.invited": "invited", "people.state.expired": "did not come in time", "people.state.joined": "not here now", "people.state.here": "here", "people.state.revoked": "taken back", "people.revoke": "Take back", "people.failed": "Not done: {why}",
  "holds.title": "Who has which vehicle", "holds.free": "free", "holds.take": "Take", "holds.ask": "Ask for it", "holds.give": "Hand over", "holds.keep": "Keep", "holds.release": "Let go",
  "holds.has": "{name} has {vehicle}.", "holds.yours": "You have {vehicle}.", "holds.asks": "{name} asks for {vehicle}.", "holds.asked": "You have asked {name} for {vehicle}. All pilots may pause, return and land it.",
  "log.title": "Who did what", "log.none": "Nothing yet.", "log.row": "{time} {name}, {role}: {action} {target}", "log.count": "({count} times)", "log.outcome.done": "done", "log.outcome.refused": "refused", "log.outcome.not_sent": "not sent", "log.outcome.unknown": "unknown", "log.outcome.asked": "asked",
};
