"""Scripts of the console's pure modules, run by the Node that comes with playwright."""

import json
import subprocess
from pathlib import Path
from typing import Any

from playwright._impl._driver import compute_driver_executable


def node() -> str:
    """Returns the path of the Node that comes with playwright."""
    return compute_driver_executable()[0]


def evaluate(module: Path, expression: str, argument: object = None) -> Any:
    """The value, by way of JSON, of a JavaScript expression over ``m``, the module's exports, and ``given``."""
    script = (
        f"const m = await import({json.dumps(module.as_uri())}); let text = '';"
        "for await (const part of process.stdin) text += part;"
        f"const given = JSON.parse(text); console.log(JSON.stringify({expression}));"
    )
    command = [node(), "--no-warnings", "--input-type=module", "--eval", script]
    done = subprocess.run(command, input=json.dumps(argument), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
