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
  "log.act.start": "start", "log.act.pause": "pause", "log.act.resume": "resume", "log.act.continue": "continue mission", "log.act.rtl": "return", "log.act.return": "return in turn", "log.act.land": "land", "log.act.upload": "upload mission", "log.act.fence": "upload fence", "log.act.plan": "plan", "log.act.edit plan": "edit plan", "log.act.plan gaps": "plan gaps", "log.act.find": "mark find", "log.act.change find": "change find", "log.act.remove find": "remove find", "log.act.refine": "refine", "log.act.export": "export", "log.act.check": "check before start", "log.act.start plan": "start plan", "log.act.cancel start": "cancel start", "log.act.command": "command", "log.act.hold": "take or hand over", "log.act.take": "take", "log.act.give": "hand over", "log.act.keep": "keep", "log.act.free": "let go", "log.act.invite": "invite", "log.act.revoke": "take back invitation", "log.act.join": "join",
};

export const germanPeople = {
  "people.title": "Personen", "people.close": "Schließen", "people.you": "Sie sind {name}, {role}.", "people.you.operator": "Sie sind Einsatzleitung: Sie können alles und laden andere ein.",
  "people.you.look": "Diese Seite hat kein Token und keine Einladung: Sie kann zusehen, sonst nichts.",
  "people.look": "Diese Seite kann nur zusehen: Kein Befehl geht hinaus. Den Link öffnen, den die Bodenstation ausgegeben hat, oder eine Einladung, oder das Token unter Einstellungen eingeben.",
  "people.out": "Diese Seite darf weder zusehen noch befehlen. Den Link öffnen, den die Bodenstation ausgegeben hat, oder eine Einladung, oder das Token unter Einstellungen eingeben.",
  "people.locked": "Dazu braucht es die Rolle {role}. Bei der Einsatzleitung um eine Einladung bitten.",
  "role.viewer": "Zuschauer", "role.analyst": "Auswerter", "role.pilot": "Pilot", "role.operator": "Einsatzleitung",
  "role.viewer.about": "Zuschauer: sieht zu", "role.analyst.about": "Auswerter: plant, markiert, exportiert", "role.pilot.about": "Pilot: befiehlt auch Drohnen",
  "people.invite": "Einladen", "people.name": "Name", "people.role": "Rolle", "people.link": "{name} diesen Code zeigen oder den Link schicken. Er gilt einmal, einen Tag lang.", "people.copy": "Link kopieren", "people.copied": "Kopiert", "people.uncopied": "Nicht kopiert: den Link markieren und kopieren",
  "people.qr": "Code der Einladung", "people.lan": "Andere können teilnehmen, wenn die Bodenstation mit --lan gestartet wird.", "people.none": "Noch niemand eingeladen.",
  "people.state.invited": "eingeladen", "people.state.expired": "nicht rechtzeitig gekommen", "people.state.joined": "gerade nicht da", "people.state.here": "da", "people.state.revoked": "zurückgenommen", "people.revoke": "Zurücknehmen", "people.failed": "Nicht ausgeführt: {why}",
  "holds.title": "Wer welche Drohne hat", "holds.free": "frei", "holds.take": "Nehmen", "holds.ask": "Darum bitten", "holds.give": "Übergeben", "holds.keep": "Behalten", "holds.release": "Freigeben",
  "holds.has": "{name} hat {vehicle}.", "holds.yours": "Sie haben {vehicle}.", "holds.asks": "{name} bittet um {vehicle}.", "holds.asked": "Sie haben {name} um {vehicle} gebeten. Pausieren, zurückholen und landen darf jeder Pilot.",
  "log.title": "Wer was getan hat", "log.none": "Noch nichts.", "log.row": "{time} {name}, {role}: {action} {target}", "log.count": "({count}-mal)", "log.outcome.done": "ausgeführt", "log.outcome.refused": "abgelehnt", "log.outcome.not_sent": "nicht gesendet", "log.outcome.unknown": "unbekannt", "log.outcome.asked": "angefragt",
  "log.act.start": "Start", "log.act.pause": "Pause", "log.act.resume": "Fortsetzen", "log.act.continue": "Mission fortsetzen", "log.act.rtl": "Rückkehr", "log.act.return": "Rückkehr nacheinander", "log.act.land": "Landen", "log.act.upload": "Mission laden", "log.act.fence": "Zaun laden", "log.act.plan": "Planung", "log.act.edit plan": "Plan geändert", "log.act.plan gaps": "Lücken geplant", "log.act.find": "Fund markiert", "log.act.change find": "Fund geändert", "log.act.remove find": "Fund entfernt", "log.act.refine": "Verfeinerung", "log.act.export": "Export", "log.act.check": "Prüfung vor dem Start", "log.act.start plan": "Plan gestartet", "log.act.cancel start": "Start abgebrochen", "log.act.command": "Befehl", "log.act.hold": "Nehmen oder übergeben", "log.act.take": "Nehmen", "log.act.give": "Übergeben", "log.act.keep": "Behalten", "log.act.free": "Freigeben", "log.act.invite": "Einladung", "log.act.revoke": "Einladung zurückgenommen", "log.act.join": "Beitritt",
};
