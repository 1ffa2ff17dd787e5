"""Lists the public type of every problem and of every failed job, with its title: stable names on which programs may
rely.

A title is the words of its type. Types are listed explicitly, not derived from class names or messages, which may
change: a renamed class keeps its type by an entry in ``FAILURE_TYPES``. In an HTTP answer ``urn:eigenhead:problem:``
stands before a type.
"""

URN = "urn:eigenhead:problem:"

REFUSED = """
batch-active batch-ended board-shot calibration-active calibration-poor camera-missing capture-in-use
capture-missing changed-since consent-missing data-unwritable database-unavailable deliveries-off delivery-active
delivery-failed disk-full file-damaged film-capture first-key foreign-origin idempotency-conflict import-failed
imports-off internal-error job-active key-invalid key-missing no-board no-capture no-result no-parquet none-failed
not-calibrated not-found object-missing other-board other-rig own-key plates-failed plates-occupied result-missing
rig-unavailable scope-missing shot-failed simulated-rig some-refused still-writing store-denied store-unavailable
too-few-shots too-late too-many-checks too-many-uploads too-many-batches too-many-jobs upload-busy upload-too-large
url-refused
"""  # what a request asks and the service refuses
REFUSED_BY_HTTP = """
bad-request body-silent body-too-large checksum-mismatch client-gone conflict field-too-large fields-too-many
file-missing file-repeated forbidden header-too-large http-error internal-server-error invalid-request
length-required malformed-body method-not-allowed not-acceptable range-not-satisfiable request-entity-too-large
service-unavailable too-many-requests tus-version unauthorized unknown-checksum unprocessable-entity
unsupported-media-type upload-length upload-metadata wrong-offset
"""  # what HTTP itself refuses
UNUSABLE = """
check-out-of-memory check-too-long invalid-archive invalid-board invalid-calibration invalid-cameras invalid-capture
invalid-captures invalid-cleanplates invalid-cursor invalid-expression invalid-features invalid-form
invalid-frontcamera invalid-input invalid-key invalid-model invalid-photographs invalid-picture invalid-plates
invalid-queue invalid-rig invalid-scale invalid-settings invalid-tags
"""  # input that cannot be used
FAILED_BY_ERROR = """
bad-model bad-template calibration-refused cannot-fetch cannot-import compute-unavailable damaged-network
egl-unavailable eigenhead-error exchanged-pictures image-too-large implausible-result no-clinic no-landmark-map
no-layout no-point no-subject no-surface no-usd not-a-manifold other-model pose-graph-error same-pictures
shipped-model too-few-captures too-few-features too-few-views unexplained-outlines unknown-model unknown-template
wrong-board wrong-features wrong-name wrong-rig wrong-scale wrong-thread
"""  # why a job failed: each is the name of an error's class, in words
FAILED = "out-of-memory work-crashed worker-died"  # how its work ended otherwise
PROBLEM_TYPES = {
    kind: kind.replace("-", " ").capitalize()
    for kinds in (REFUSED, REFUSED_BY_HTTP, UNUSABLE, FAILED_BY_ERROR, FAILED)
    for kind in kinds.split()
}

SUBJECTS = (
    "archive, board, board.toml, calibration, cameras.json, capture, captures, clean plates, cursor, expression, "
    "features.json, form, front camera, key, model, photographs, picture, plates.json, queue, request, rig, rig.toml, "
    "scale.json, settings, tags"
)
INPUT_TYPES = {subject: "invalid-" + subject.partition(".")[0].replace(" ", "") for subject in SUBJECTS.split(", ")}
"""The type of an ``InputError`` by its subject; of any other, a file that somebody sent, it is ``invalid-input``."""

FAILURE_TYPES = {kind.title().replace("-", ""): kind for kind in FAILED_BY_ERROR.split()} | {
    "Damaged": "bad-model",
    "ShotFailed": "shot-failed",
    "bug": "internal-error",
    "crash": "work-crashed",
    "disk-full": "disk-full",
    "killed": "work-crashed",
    "out-of-memory": "out-of-memory",
}
"""The type of a failure by the error's class, or by what the child process says of the end of its work."""

HTTP_TYPES = {
    400: "bad-request",
    401: "unauthorized",
    403: "forbidden",
    404: "not-found",
    405: "method-not-allowed",
    406: "not-acceptable",
    409: "conflict",
    411: "length-required",
    413: "request-entity-too-large",
    415: "unsupported-media-type",
    422: "unprocessable-entity",
    429: "too-many-requests",
    500: "internal-server-error",
    503: "service-unavailable",
}
"""The type of what the web framework refuses by itself, by its status; of any other it is ``http-error``."""


def type_of_input(subject: str) -> str:
    """Returns the stable name of the problem for an ``InputError`` about ``subject``."""
    return INPUT_TYPES.get(subject, "invalid-input")


def type_of_failure(kind: str) -> str:
    """Returns the stable name of the problem for failed work. ``kind``: the class of the work's error, or how the
    work's child process ended."""
    return FAILURE_TYPES.get(kind, "eigenhead-error")
