"""Defines the settings of the service, which come from the command line, from EIGENHEAD_* variables, or from this
module's defaults."""

import json
import re
from pathlib import Path

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict, SettingsError

from pipeline.head_model.model_names import data_folder
from server.address import is_loopback

PREFIX = "EIGENHEAD_"
ORIGIN = re.compile(r"^https?://[^/?#\s@]+$")
OBJECT_PREFIX = re.compile(r"^(s3://[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]|file:/)/(.*/)?$", re.DOTALL)
RECONSTRUCT = ".tasks.reconstruct:reconstruct_capture"
DATABASES = ("sqlite", "postgres", "postgresql", "postgresql+psycopg")
DATABASES_TOLD = "wanted is postgresql://HOST/NAME or sqlite:////FILE, or nothing for SQLite in the data folder"
MOVED: dict[str, str] = {"server.work:reconstruct_capture": RECONSTRUCT}


class ServiceSettings(BaseSettings):
    """Holds the settings of an operator. Each field is also an environment variable ``EIGENHEAD_<FIELD>``."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, env_ignore_empty=True, frozen=True, extra="forbid")

    data: Path = Field(default_factory=data_folder, description="folder of captures, results and the job database")
    database_url: str | None = Field(default=None, description="postgresql://...; without it SQLite in the data folder")
    host: str = Field(
        default="127.0.0.1", description="the address to listen at; beyond loopback only once there is an API key"
    )
    port: int = Field(default=8600, ge=0, le=65535, description="the port to listen at; 0: any that is free")
    public_url: str | None = Field(
        default=None,
        pattern=r"^https?://[^/?#\s]+$",
        description="how browsers reach the service through a proxy, such as https://heads.example; needs an API key",
    )
    cors_origins: tuple[str, ...] = Field(
        default=(), description="other web pages that may call the API with a key, such as https://lab.example"
    )
    import_origins: tuple[str, ...] = Field(
        default=(), description="where callers may import captures from, such as https://store.example; https://*: any"
    )
    import_s: float = Field(default=600.0, gt=0, description="the longest that fetching an archive may take")
    import_prefixes: tuple[str, ...] = Field(
        default=(), description="where in object stores captures may lie, such as s3://studio/incoming/"
    )
    deliver_prefixes: tuple[str, ...] = Field(
        default=(), description="where in object stores jobs may deliver results, such as s3://studio/heads/"
    )
    deliver_hours: float = Field(
        default=72.0, gt=0, description="how long a delivery waits for a store that does not answer"
    )
    captures_store: str | None = Field(
        default=None,
        pattern=OBJECT_PREFIX.pattern,
        description="where files of captures lie, for workers without this data folder, such as s3://studio/captures/",
    )
    captures_bytes: int = Field(
        default=64 << 30, ge=0, description="the most that files of captures in that store take in a data folder"
    )
    results_store: str | None = Field(
        default=None,
        pattern=OBJECT_PREFIX.pattern,
        description="where results lie, such as s3://studio/results/; without it in the data folder alone",
    )
    results_bytes: int = Field(
        default=64 << 30, ge=0, description="the most that large files of results in that store take in the data folder"
    )
    keep_unclaimed_days: float | None = Field(
        default=30.0, gt=0, description="age at which results in that store go that no job claims; None keeps them"
    )
    store_endpoint: str | None = Field(
        default=None, pattern=r"^https?://[^?#\s]+$", description="address of the S3-compatible store; else Amazon's"
    )
    store_region: str | None = Field(default=None, description="region of the store; without it what AWS_REGION says")
    store_timeout_s: float = Field(default=10.0, gt=0, description="how long an object store may be silent")
    webhook_origins: tuple[str, ...] = Field(
        default=(), description="where a job may name a webhook of its own; https://*: any public one"
    )
    rig: Path | None = Field(default=None, description="rig.toml; without it the simulated studio")

    queue: str = Field(
        default="cpu", pattern="^[a-z0-9_-]{1,32}$", description="the queue that jobs go to and a worker serves"
    )
    queues: tuple[str, ...] = Field(default=("cpu", "gpu"), description="queues that a job may name")
    concurrency: int = Field(default=1, ge=1, le=64, description="jobs that one worker runs at once")
    work: str = Field(default=RECONSTRUCT, description="what a job runs in the worker's child process")
    heartbeat_s: float = Field(default=3.0, gt=0, description="how often a worker says that it is alive")
    silent_s: float = Field(
        default=15.0, gt=0, description="a worker that is silent for longer is dead; its jobs are taken over"
    )
    poll_s: float = Field(default=0.25, gt=0, description="how often a worker looks for jobs, and a stream for events")
    attempts: int = Field(default=50, ge=1, description="a job that took so many workers down with it fails")

    body_bytes: int = Field(default=8 << 30, ge=1, description="the largest upload")
    archive_members: int = Field(default=5000, ge=1, description="the most files and folders of one archive")
    archive_bytes: int = Field(default=16 << 30, ge=1, description="the most that one archive unpacks to")
    archive_ratio: float = Field(default=100.0, gt=1, description="the most that an archive may unpack to, by its size")
    image_pixels: int = Field(default=64_000_000, ge=1, description="pixels of the largest picture of a capture")
    free_bytes: int = Field(default=256 << 20, ge=0, description="disk space that uploads and jobs must leave")
    jobs_per_key: int = Field(default=200, ge=1, description="queued and running jobs of one API key")
    uploads_per_key: int = Field(default=100, ge=1, description="unfinished resumable uploads of one API key")
    batches_per_key: int = Field(default=100, ge=1, description="unfinished batches of one API key")
    batch_captures: int = Field(default=10_000, ge=1, description="the most captures of one batch")
    checks_at_once: int = Field(default=2, ge=1, description="processes that unpack and check uploads")
    check_s: float = Field(default=900.0, gt=0, description="the longest that the check of one upload may take")
    check_bytes: int = Field(default=4 << 30, ge=0, description="memory of each of these processes; 0: any")
    upload_hours: float = Field(default=48.0, gt=0, description="how long an unfinished resumable upload is kept")

    keep_results_days: float | None = Field(
        default=None, gt=0, description="age at which finished jobs go; None keeps them"
    )
    keep_captures_days: float | None = Field(
        default=None, gt=0, description="age at which captures go; None keeps them"
    )
    keep_jobs: int | None = Field(default=None, ge=0, description="the number of finished jobs kept")
    make_room: bool = Field(
        default=False, description="drop the oldest finished results when the disk falls below free_bytes"
    )
    cache_bytes: int = Field(default=4 << 30, ge=0, description="the most that silhouettes and thumbnails take up")
    sweep_s: float = Field(default=60.0, gt=0, description="how often what is to go is looked for")

    ask_consent: bool = Field(default=False, description="captures need a session with a note of the subject's consent")
    console: bool = Field(default=True, description="serve the operator's pages; they add 1.5 s to the start")
    log_json: bool = Field(default=False, description="log lines as JSON")

    @field_validator("work")
    @classmethod
    def _present_place(cls, address: str) -> str:
        """Returns the current name of a folder that a variable of an older version names."""
        return MOVED.get(address, address)

    @field_validator("database_url")
    @classmethod
    def _known_database(cls, url: str | None) -> str | None:
        if url is None:
            return None
        from sqlalchemy import make_url  # half a second that a service on SQLite need not wait
        from sqlalchemy.exc import ArgumentError

        try:
            driver = make_url(url).drivername
        except (ArgumentError, ValueError) as error:
            raise ValueError(f"is no database's URL; {DATABASES_TOLD}") from error
        if driver not in DATABASES:
            raise ValueError(f"{driver!r:.40} is no database that the service can use; {DATABASES_TOLD}")
        return url

    @field_validator("import_origins", "webhook_origins")
    @classmethod
    def _origins(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        for origin in origins:
            if not ORIGIN.match(origin):
                raise ValueError(f"{origin!r} is no origin; give scheme://host or scheme://host:port, no path")
        return origins

    @field_validator("import_prefixes", "deliver_prefixes")
    @classmethod
    def _object_prefixes(cls, prefixes: tuple[str, ...]) -> tuple[str, ...]:
        for prefix in prefixes:
            if not OBJECT_PREFIX.match(prefix):
                wanted = "give s3://bucket/folder/ or file:///folder/, with the slash at the end"
                raise ValueError(f"{prefix!r} is no place in an object store; {wanted}")
        return prefixes

    @property
    def public_host(self) -> str | None:
        """Returns host and port of ``public_url``; None if it is not set."""
        return None if self.public_url is None else self.public_url.partition("://")[2]

    @property
    def is_private(self) -> bool:
        """Returns whether only programs on this machine can reach the service, so that it may run without API keys."""
        return self.public_url is None and is_loopback(self.host)

    @property
    def url(self) -> str:
        """Returns the database's URL in SQLAlchemy's form.

        In the URL PostgreSQL is told to end a session that is idle inside a transaction: otherwise a vanished worker
        would keep its row locks, and no other worker could take over its job.
        """
        if self.database_url is None:
            return f"sqlite:///{self.data.resolve() / 'eigenhead.sqlite'}"
        scheme, _, rest = self.database_url.partition("://")
        if scheme not in ("postgres", "postgresql"):
            return self.database_url
        if "options=" not in rest:
            rest += "&" if "?" in rest else "?"
            rest += f"options=-c%20idle_in_transaction_session_timeout%3D{round(self.silent_s * 1000)}"
        return f"postgresql+psycopg://{rest}"

    @property
    def place(self) -> str:
        """Returns the location of keys and jobs for people: the data folder, or the database's URL without password."""
        if self.database_url is None:
            return str(self.data.resolve())
        import sqlalchemy as sa  # half a second that a service on SQLite, and `eigenhead doctor`, need not wait

        return sa.make_url(self.url).render_as_string(hide_password=True).partition("?")[0]

    def environment(self) -> dict[str, str]:
        """Returns the environment variables with which another process reads the same settings."""
        values = self.model_dump(mode="json", exclude_defaults=True) | {"data": str(self.data.resolve())}
        return {
            PREFIX + k.upper(): v if isinstance(v, str) else json.dumps(v) for k, v in values.items() if v is not None
        }


def variable_in(error: SettingsError) -> str:
    """Returns the environment variable whose value could not be decoded; pydantic names the variable's field only in
    the error's text."""
    return next((PREFIX + name.upper() for name in ServiceSettings.model_fields if f'"{name}"' in str(error)), PREFIX)
