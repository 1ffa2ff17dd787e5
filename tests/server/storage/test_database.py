"""The service's database: whose its files are."""

import os
from pathlib import Path

import sqlalchemy as sa

from server.services.keys import Keys
from server.settings import ServiceSettings
from server.storage.batches import BatchIndex, BatchRow
from server.storage.database import capture_tags, open_database, scrub

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


def test_tables_of_an_earlier_version_get_their_columns(tmp_path: Path) -> None:
    settings = ServiceSettings(data=tmp_path)
    engine = open_database(settings)
    with engine.begin() as connection:
        connection.execute(sa.text("ALTER TABLE eigenhead_batches DROP COLUMN deliver_to"))
    engine.dispose()
    again = open_database(settings)
    row = BatchRow("b", 1, "", "local", "", "cpu", 500, None, {}, deliver_to="s3://studio/heads/")
    BatchIndex(again).add(row, ["c"])
    assert BatchIndex(again).get("b") == row
    again.dispose()


def test_a_connection_that_scrubbed_begins_its_transactions_as_before(tmp_path: Path) -> None:
    engine = open_database(ServiceSettings(data=tmp_path / "data"))
    with engine.begin() as connection:
        connection.execute(sa.insert(capture_tags).values(capture_id="a", folded="anna", name="Anna"))
    scrub(engine)
    wal = tmp_path / "data" / "eigenhead.sqlite-wal"
    assert wal.stat().st_size == 0, "nothing of what was deleted is left there"
    with engine.connect() as connection:
        driver = connection.connection.dbapi_connection
        assert getattr(driver, "isolation_level", None) == "IMMEDIATE"
    engine.dispose()
