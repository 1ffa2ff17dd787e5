"""The service's database: whose its files are."""

import os
from pathlib import Path

from server.services.keys import Keys
from server.settings import ServiceSettings
from server.storage.database import open_database

NOBODY = 65534


def test_a_key_that_root_makes_leaves_the_database_to_the_data_folders_owner(tmp_path: Path) -> None:
    """`sudo eigenhead keys add` for a service that systemd starts as a user of its own."""
    data = tmp_path / "data"
    data.mkdir()
    if os.geteuid() == 0:
        os.chown(data, NOBODY, NOBODY)
    engine = open_database(ServiceSettings(data=data))
    Keys(engine).add("admin", ("admin",))
    assert {path.stat().st_uid for path in data.iterdir()} == {data.stat().st_uid}
    engine.dispose()
