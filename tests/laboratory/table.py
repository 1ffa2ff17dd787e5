"""Lists the experiments and benchmarks of ``python -m tests.laboratory``."""

from tests.laboratory import inputs
from tests.laboratory.runner import Record

EXPERIMENTS = {
    "table1": Record("experiments.paper.tables:table1", "Repeats tables 1 and 2 of the paper, and figures 4 and 5."),
    "table2": Record("experiments.paper.tables:table2", "Repeats table 2 of the paper alone."),
    "table3": Record("experiments.paper.tables:table3", "Repeats table 3: four arrangements of eleven cameras."),
    "cost": Record("experiments.paper.cost:cost", "Compares the paper's eqs. (4) and (5) on subjects with hair."),
    "levels": Record("experiments.paper.levels:levels", "Measures what the hierarchy of section 5.1 saves."),
    "peers": Record("experiments.peers.peers:peers", "Compares the contour solver with other solvers."),
    "limit": Record("experiments.paper.limit:limit", "Compares errors with the Cramer-Rao bound, counts intervals."),
    "robustness": Record("experiments.paper.robustness:robustness", "Measures what worse input costs the solver."),
    "convergence": Record("experiments.paper.convergence:convergence", "Counts how often the solver converges."),
    "alignment": Record("experiments.paper.alignment:alignment", "Counts right alignments without feature points."),
    "drift": Record("experiments.faults.drift:drift", "Counts how often a turned camera, and a good one, is named."),
    "exchanges": Record("experiments.faults.exchanges:exchanges", "Counts how often exchanged pictures are repaired."),
    "posterior": Record("experiments.paper.posterior_check:posterior_check", "Compares it with a Markov chain."),
    "views": Record("experiments.paper.views:views", "Plans where cameras should stand."),
    "repeat": Record("experiments.surface.repeat:repeat", "Measures how well repeated shots of one subject agree."),
    "relief": Record(
        "experiments.surface.relief:relief",
        "Measures how much of the skin's relief two halves of the views share.",
        {"captures": inputs.named_captures},
    ),
    "pores": Record("experiments.surface.pores:pores", "Measures the detail `pores` on a known relief at 24 Mpx."),
    "span": Record(
        "experiments.paper.span:run",
        "Measures how closely a model can represent a real face.",
        {"truths": inputs.span_truths},
    ),
    "detail": Record(
        "experiments.paper.detail:run", "Compares the levels of detail.", {"captures": inputs.known_captures}
    ),
    "hidden": Record(
        "experiments.surface.hidden:hidden",
        "Measures visible and hidden skin, and counts intervals at every level of detail.",
        {"captures": inputs.requested_captures, "realism": inputs.realism},
    ),
    "capped": Record("experiments.surface.capped:capped", "Measures the cranium under a swim or wig cap."),
    "skulls": Record("experiments.surface.capped:skulls", "Counts heads called bald; craniums under hair."),
    "moments": Record("experiments.moments.takes:moments", "Measures takes: one person in several moments."),
    "expressions": Record("experiments.people.expressions:expressions", "Measures heads with an expression."),
    "people": Record(
        "experiments.people.people:people",
        "Counts right, warned and silently wrong captures of living people.",
        {"others": inputs.facekit_or_none, "captures": inputs.folders_or_known},
    ),
    "guards": Record(
        "experiments.people.guards:guards",
        "Counts false alarms and hits of every check that can refuse a capture.",
        {"folders": inputs.folders_or_known},
    ),
    "living": Record(
        "experiments.people.living:living",
        "Compares heads of living people from few and many cameras.",
        {"folders": inputs.photograph_folders},
    ),
    "planted": Record("experiments.faults.planted:planted", "Runs whole jobs on pictures with faults of studios."),
    "visible": Record(
        "experiments.surface.visible:visible",
        "Measures the whole visible surface for every hair style of the studio.",
        {"captures": inputs.requested_captures, "realism": inputs.realism},
    ),
    "surfaces": Record(
        "experiments.surface.surfaces:surfaces",
        "Compares the visible surface with other programs' results.",
        {"captures": inputs.known_captures},
    ),
    "texture": Record(
        "experiments.surface.texture:texture",
        "Compares a drawn head with a photograph that was not used.",
        {"captures": inputs.requested_captures},
    ),
    "light": Record("experiments.surface.light:light", "Measures how well the albedo removes light."),
    "templates": Record("experiments.surface.templates:templates", "Measures round trips through a template."),
    "shapes": Record("experiments.surface.shapes:shapes", "Measures expression shapes carried to foreign meshes."),
    "eyeballs": Record("experiments.surface.eyeballs:eyeballs", "Counts triangles of eyeballs that cross lids."),
    "gazes": Record("experiments.people.gazes:gazes", "Measures irises, gaze and pupil distance."),
    "inner-mouth": Record("experiments.surface.inner_mouth:inner_mouths", "Counts skin that meets teeth and tongue."),
    "wrap": Record(
        "experiments.surface.wrapping:wrapping",
        "Measures how close wrapping brings a template to scans.",
        {"truths": inputs.chosen_truths},
    ),
    "meshes": Record("experiments.surface.meshes:meshes", "Counts turned, folded and crossing triangles of results."),
    "scaling": Record(
        "experiments.speed.scaling:scaling",
        "Estimates what more cores would gain for a default job.",
        {"captures": inputs.timed_captures},
    ),
    "growth": Record(
        "experiments.speed.growth:growth",
        "Measures how a job grows with the number of views and of pixels.",
        {"chosen": inputs.job_sizes},
    ),
    "scale": Record("experiments.speed.farm:scale", "Simulates a farm of workers, and prices its heads."),
    "real": Record(
        "experiments.faults.real:real",
        "Judges heads from real photographs by views that were not used.",
        {"folders": inputs.photograph_folders},
    ),
    "reports": Record("experiments.faults.reports:reports", "Judges what each door answers to the shared reports."),
}

BENCHMARKS = {
    "attacks": Record("benchmarks.attacks:run", "Attacks a service over loopback, and says what held."),
    "capture_leaks": Record("benchmarks.capture_leaks:run", "Takes many captures, and measures what grows."),
    "captures": Record("benchmarks.captures:run", "Measures errors of the shared captures at every level of detail."),
    "described_requests": Record("benchmarks.described_requests:run", "Counts 5xx that schemathesis gets, by scope."),
    "remaining-time": Record("benchmarks.remaining_time:run", "Judges the remaining time that jobs tell."),
    "scene_calibration": Record("benchmarks.scene_calibration:run", "Judges calibration from photographs alone."),
    "side_by_side": Record("benchmarks.side_by_side:run", "Compares two checkouts on the same captures."),
    "studio_masks": Record("benchmarks.studio_masks:run", "Compares masks of the studio with the truth."),
}
