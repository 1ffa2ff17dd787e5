"""Opens object stores (a folder or a bucket), and checks which locations a caller may name.

Buckets are S3-compatible and reached through botocore (the extra ``s3``). Credentials come from AWS's usual sources:
variables, profile, or the role of machine, container or pod. Files of more than one part are uploaded in parts; the
object appears when the last request completes it. Each request carries the SHA-256 of its bytes, and each object has
the SHA-256 of its content in its metadata, with which every read is compared.
"""

import base64
import hashlib
import mimetypes
import unicodedata
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

from rig.files import sha256_of
from rig.messages.message import Message, compose
from server.errors import UrlRefused
from server.settings import OBJECT_PREFIX, ServiceSettings
from server.storage.objects import (
    BLOCK_BYTES,
    Admission,
    FolderObjects,
    ObjectMissing,
    ObjectStore,
    StoreDenied,
    StoredObject,
    StoreUnavailable,
    any_size,
)

KEY_BYTES_MOST = 900  # S3 takes 1024, with the prefix
PART_BYTES = 8 << 20  # S3 takes at most 10,000 parts of at least 5 MiB: 80 GB of these
CONNECT_S = 5.0
TRIES = 3  # of one request, and of one object whose bytes are damaged on their way
SHA256 = "sha256"  # in an object's metadata
DAMAGED = ("BadDigest", "InvalidDigest", "XAmzContentSHA256Mismatch", "XAmzContentChecksumMismatch", "IncompleteBody")
PASSING = ("SlowDown", "RequestTimeout", "OperationAborted", "NoSuchUpload", "InvalidPart")
MISSING = ("NoSuchKey", "404", "NotFound")
T = TypeVar("T")


@lru_cache
def _client(endpoint: str | None, region: str | None, timeout_s: float) -> Any:
    """Makes an S3 client, which threads may share, within about a second."""
    from botocore.config import Config
    from botocore.session import Session

    config = Config(
        connect_timeout=min(CONNECT_S, timeout_s),
        read_timeout=timeout_s,
        signature_version="s3v4",  # signed addresses take an older one by default, which newer stores refuse
        retries={"mode": "standard", "total_max_attempts": TRIES},
        s3={"addressing_style": "auto" if endpoint is None else "path"},
        request_checksum_calculation="when_required",  # each request brings its own SHA-256
        response_checksum_validation="when_supported",
        max_pool_connections=16,
    )
    session = Session()
    where = region or session.get_config_variable("region") or "us-east-1"
    return session.create_client("s3", region_name=where, endpoint_url=endpoint, config=config)


class DamagedTransfer(StoreUnavailable):
    """Reports bytes that were cut off or changed in transit. A damaged transfer is repeated at once; the S3 client
    itself repeats requests without an answer."""


class S3Objects:
    """Keeps objects below a prefix of a bucket."""

    def __init__(self, client: Any, bucket: str, prefix: str) -> None:
        self._client, self._bucket, self._prefix = client, bucket, prefix

    def put(self, key: str, path: Path, sha256: str) -> None:
        """Stores a file, as in ``ObjectStore``."""
        _repeated(lambda: self._put(key, path, sha256))

    def fetch(self, key: str, path: Path, sha256: str | None = None, admit: Admission = any_size) -> str:
        """Writes an object to a file, as in ``ObjectStore``."""
        try:
            return _repeated(lambda: self._fetch(key, path, sha256, admit))
        except BaseException:
            path.unlink(missing_ok=True)
            raise

    def entries(self, prefix: str) -> Iterator[StoredObject]:
        """Yields the objects below a key, as in ``ObjectStore``."""
        with self._asking(prefix):
            pages = self._client.get_paginator("list_objects_v2")
            for page in pages.paginate(Bucket=self._bucket, Prefix=self._prefix + prefix):
                for entry in page.get("Contents", ()):
                    if not entry["Key"].endswith("/"):  # what consoles make to show an empty folder
                        yield StoredObject(
                            entry["Key"].removeprefix(self._prefix), entry["Size"], entry["LastModified"].timestamp()
                        )

    def folders(self) -> Iterator[str]:
        """Yields the first parts of keys, as in ``ObjectStore``."""
        with self._asking(""):
            pages = self._client.get_paginator("list_objects_v2")
            for page in pages.paginate(Bucket=self._bucket, Prefix=self._prefix, Delimiter="/"):
                for entry in page.get("CommonPrefixes", ()):
                    yield entry["Prefix"].removeprefix(self._prefix).removesuffix("/")

    def link(self, key: str, name: str, seconds: int) -> str | None:
        """Returns a signed address of an object, as in ``ObjectStore``."""
        with self._asking(key):
            self._client.head_object(**self._at(key))
            wanted = self._at(key) | {"ResponseContentDisposition": f"attachment; filename*=UTF-8''{quote(name)}"}
            return self._client.generate_presigned_url("get_object", Params=wanted, ExpiresIn=seconds)

    def erase(self, prefix: str) -> int:
        """Removes all objects below a key and returns how many, as in ``ObjectStore``."""
        removed, below = set[str](), {"Bucket": self._bucket, "Prefix": self._prefix + prefix}
        with self._asking(prefix):
            for page in self._client.get_paginator("list_multipart_uploads").paginate(**below):
                for upload in page.get("Uploads", ()):
                    one = {"Key": upload["Key"], "UploadId": upload["UploadId"]}
                    self._client.abort_multipart_upload(Bucket=self._bucket, **one)
            for page in self._client.get_paginator("list_object_versions").paginate(**below):
                entries = [*page.get("Versions", ()), *page.get("DeleteMarkers", ())]
                objects = [{"Key": entry["Key"], "VersionId": entry["VersionId"]} for entry in entries]
                if objects:
                    wanted = {"Objects": objects, "Quiet": True}
                    answer = self._client.delete_objects(Bucket=self._bucket, Delete=wanted)
                    for error in answer.get("Errors", ()):
                        raise StoreDenied(self._place(error["Key"]), error["Code"])
                removed |= {entry["Key"] for entry in page.get("Versions", ())}
        return len(removed)

    def _at(self, key: str) -> dict[str, str]:
        return {"Bucket": self._bucket, "Key": self._prefix + key}

    def _place(self, key: str) -> str:
        return f"s3://{self._bucket}/{self._prefix}{key}"

    def _check(self, key: str, digest: str, wanted: str) -> None:
        if digest != wanted:
            raise DamagedTransfer(self._place(key), compose("store-checksum"))

    def _put(self, key: str, path: Path, sha256: str) -> None:
        with self._asking(key):
            if self._is(key, path.stat().st_size, sha256):
                return
            about = {"Metadata": {SHA256: sha256}, "ContentType": mimetypes.guess_type(key)[0] or "binary/octet-stream"}
            if path.stat().st_size <= PART_BYTES:
                data = path.read_bytes()
                self._check(key, hashlib.sha256(data).hexdigest(), sha256)
                self._client.put_object(**self._at(key), Body=data, ChecksumSHA256=_base64(data), **about)
            else:
                self._put_parts(key, path, sha256, about)
            self._check(key, self._read_back(key), sha256)

    def _is(self, key: str, size: int, sha256: str) -> bool:
        """Returns whether an equal object exists, by the store's checksum of it or by its bytes."""
        try:
            with self._asking(key):
                said = self._client.head_object(**self._at(key))
        except ObjectMissing:
            return False
        alike = said["ContentLength"] == size and said["Metadata"].get(SHA256) == sha256
        return alike and self._read_back(key) == sha256

    def _put_parts(self, key: str, path: Path, sha256: str, about: dict[str, Any]) -> None:
        begun = self._client.create_multipart_upload(**self._at(key), ChecksumAlgorithm="SHA256", **about)
        upload = self._at(key) | {"UploadId": begun["UploadId"]}
        try:
            parts, whole = [], hashlib.sha256()
            with path.open("rb") as stream:
                while data := stream.read(PART_BYTES):
                    whole.update(data)
                    part = {"PartNumber": len(parts) + 1, "ChecksumSHA256": _base64(data)}
                    answer = self._client.upload_part(**upload, **part, Body=data)
                    parts.append(part | {"ETag": answer["ETag"]})
            self._check(key, whole.hexdigest(), sha256)
            self._client.complete_multipart_upload(**upload, MultipartUpload={"Parts": parts})
        except BaseException:
            with self._asking(key):
                self._client.abort_multipart_upload(**upload)
            raise

    def _read_back(self, key: str) -> str:
        body, digest = self._client.get_object(**self._at(key))["Body"], hashlib.sha256()
        while data := body.read(BLOCK_BYTES):
            digest.update(data)
        return digest.hexdigest()

    def _fetch(self, key: str, path: Path, sha256: str | None, admit: Admission) -> str:
        """Reads an object once. The S3 client itself verifies the store's checksum; if an object lacks eigenhead's
        metadata, an ETag of 32 digits is the MD5 of the bytes, unless they are encrypted with a customer's key."""
        with self._asking(key):
            answer = self._client.get_object(**self._at(key))
            md5 = hashlib.md5(usedforsecurity=False)
            with closing(answer["Body"]), path.open("wb") as stream:
                admit(answer["ContentLength"])
                while data := answer["Body"].read(BLOCK_BYTES):
                    md5.update(data)
                    stream.write(data)
        digest, wanted = sha256_of(path), sha256 or answer["Metadata"].get(SHA256)
        self._check(key, digest, wanted or digest)
        etag, encrypted = answer["ETag"].strip('"'), answer.get("ServerSideEncryption", "AES256") != "AES256"
        if wanted is None and len(etag) == 32 and not encrypted and "SSECustomerAlgorithm" not in answer:
            self._check(key, md5.hexdigest(), etag)
        return digest

    @contextmanager
    def _asking(self, key: str) -> Iterator[None]:
        """Converts the client's exceptions to those of this project."""
        from botocore.exceptions import (
            BotoCoreError,
            ClientError,
            CredentialRetrievalError,
            FlexibleChecksumError,
            IncompleteReadError,
            NoCredentialsError,
            PartialCredentialsError,
            ResponseStreamingError,
        )

        try:
            yield
        except ClientError as error:
            code = str(error.response.get("Error", {}).get("Code", ""))
            status = error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0)
            if code in MISSING:
                raise ObjectMissing(self._place(key)) from error
            if code in DAMAGED:
                raise DamagedTransfer(self._place(key), f"{status} {code}") from error
            if status >= 500 or status in (408, 429) or code in PASSING:
                raise StoreUnavailable(self._place(key), f"{status} {code}") from error
            raise StoreDenied(self._place(key), f"{status} {code}") from error
        except (NoCredentialsError, PartialCredentialsError, CredentialRetrievalError) as error:
            raise StoreDenied(self._place(key), str(error)) from error
        except (FlexibleChecksumError, IncompleteReadError, ResponseStreamingError) as error:
            raise DamagedTransfer(self._place(key), type(error).__name__) from error
        except BotoCoreError as error:
            raise StoreUnavailable(self._place(key), f"{type(error).__name__}: {error}") from error


def _repeated(transfer: Callable[[], T]) -> T:
    for _ in range(TRIES - 1):
        with suppress(DamagedTransfer):
            return transfer()
    return transfer()


def _base64(data: bytes) -> str:
    return base64.b64encode(hashlib.sha256(data).digest()).decode()


def key_faults(key: str) -> list[Message]:
    """Returns the faults of a key, or of a prefix that ends with a slash."""
    if any(unicodedata.category(c) in ("Cc", "Cs") for c in key) or "\\" in key:
        return [compose("key-characters")]
    if len(key.encode()) > KEY_BYTES_MOST:
        return [compose("key-long", most=KEY_BYTES_MOST)]
    if any(part in ("", ".", "..") for part in key.removesuffix("/").split("/")):
        return [compose("key-parts")]
    return []


def locate(url: str, prefixes: Collection[str]) -> tuple[str, str]:
    """Returns the allowed prefix that contains ``url``, and the key below it. Raises InvalidInput ("url-refused")."""
    if not OBJECT_PREFIX.match(f"{url}/"):
        raise UrlRefused(compose("object-url-none"))
    for prefix in sorted(prefixes, key=len, reverse=True):
        if url.startswith(prefix):
            key = url.removeprefix(prefix)
            if key and (faults := key_faults(key)):
                raise UrlRefused(faults[0])
            return prefix, key
    raise UrlRefused(compose("object-url-not-allowed", prefixes=sorted(prefixes)))


def open_objects(prefix: str, settings: ServiceSettings) -> ObjectStore:
    """Opens the store at ``s3://bucket/prefix/`` or ``file:///folder/``, without sending a request. Raises StoreDenied
    if the extra for S3 is not installed."""
    if prefix.startswith("file://"):
        return FolderObjects(Path(prefix.removeprefix("file://")))
    bucket, _, below = prefix.removeprefix("s3://").partition("/")
    try:
        client = _client(settings.store_endpoint, settings.store_region, settings.store_timeout_s)
    except ImportError as error:
        raise StoreDenied(prefix, compose("store-extra-missing")) from error
    return S3Objects(client, bucket, below)
