// Words of the coverage.

export const coverageWords = {
  "coverage.title": "Coverage", "coverage.none": "No area yet: plan one, or draw it.", "coverage.older": "This is of the area as it was planned: it was changed since, make the plan again.", "coverage.show": "Show on the map",
  "coverage.seen": "seen", "coverage.poor": "seen poorly", "coverage.missed": "missed", "coverage.planned": "not flown",
  "coverage.recorded": "By GPS alone: {seen} seen. {placed} {placed|picture is|pictures are} placed, {left} {left|lies|lie} by GPS.",
  "coverage.gaps": "{n} {n|gap|gaps}, {size} together", "coverage.nogaps": "No gap so far.",
  "coverage.gap": "{size}: {cause}", "coverage.sure": "{sure} sure", "coverage.more": "and {n} smaller ones",
  "coverage.missing.first": "the first: {image}", "coverage.missing.row": "{name}: {n} {cause} ({first})",
  "coverage.asked.title": "{name}: {n} {n|picture|pictures} asked from the vehicle, {arrived} arrived, {open} still to come, {refused} refused",
  "coverage.asked.arrived": "Picture {number}: arrived", "coverage.asked.waiting": "Picture {number}: waits for its turn", "coverage.asked.asked": "Picture {number}: being read, {percent} %",
  "coverage.asked.refused": "Picture {number}: refused, {reason}", "coverage.asked.held": "Picture {number}: waits: {reason}",
  "coverage.state.planned": "Nothing flown yet.", "coverage.state.in flight": "In flight.", "coverage.state.complete": "The flight is over.",
  "coverage.fly": "Fly the gaps…", "coverage.offer": "{name} did not fly {legs} {legs|line|lines} ({length}): others can fly {legs|it|them} as gaps.",
  "gapflight.title": "Fly the gaps", "gapflight.about": "The plan uses the lens as it was solved and the battery that is left. Nothing is uploaded before you confirm, and nothing starts before the check.",
  "gapflight.plan": "Plan", "gapflight.confirm": "Upload, then check and start…", "gapflight.minutes": "Minutes that {name} can fly", "gapflight.left": "battery {battery}; minutes by what its flight has cost",
  "gapflight.ask": "battery {battery}; how many minutes it can fly is not known: enter them", "gapflight.unknown": "Enter how many minutes {name} can fly.", "gapflight.nobody": "No vehicle is on the links.",
  "gapflight.inair": "In the air: tick it to pause it and give it these lines in place of its mission.", "gapflight.pauses": "{name} is in the air: it is paused before it gets the new mission, and flies on when you start it.",
  "gapflight.height": "There is no plan whose height could be used: enter one.", "gapflight.failed": "Not planned: {why}", "gapflight.uploading": "Uploading…", "gapflight.refused": "Not uploaded: {list}", "gapflight.part": "{name}: {length}, ends {time} min after the start, {photos} {photos|picture|pictures}, {sorties} {sorties|flight|flights}",
};
