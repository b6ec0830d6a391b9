"""What went wrong with an object store, in half a sentence, and what to check; obstore's own texts are pages of debug output."""

import re
from typing import Final

_STATUS: Final = re.compile(r"status code: (\d{3})")
_CODE: Final = re.compile(r"<Code>([A-Za-z]{1,60})</Code>")
_RETRIES: Final = re.compile(r"after (\d+) retries")
_HOST: Final = re.compile(r"performing [A-Z]+ (https?://[A-Za-z0-9.:\[\]-]+)(?=[/?\s])")
_QUERY: Final = re.compile(r"\?\S+")
_LONGEST: Final = 160

_CREDENTIALS: Final = {
    "s3": "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (profile files are not read), or AWS_SKIP_SIGNATURE=true for a public bucket",
    "gs": "set GOOGLE_APPLICATION_CREDENTIALS, or GOOGLE_SKIP_SIGNATURE=true for a public bucket",
    "az": "set AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY, or AZURE_SKIP_SIGNATURE=true for a public container",
}
_NO_BUCKET: Final = ("NoSuchBucket", "ContainerNotFound", "specified bucket does not exist")
_METADATA_SERVICES: Final = ("169.254.169.254", "metadata.google.internal", "fd00:ec2::254")
"""Where credentials are asked for on a cloud's own machines, if the environment has none."""


def is_bucket_missing(error: BaseException) -> bool:
    """Whether not the object but its bucket or container is missing."""
    return any(mark in str(error) for mark in _NO_BUCKET)


def reason(error: BaseException, scheme: str, bucket: str) -> str:
    """Return what ``error`` of obstore means for the user of ``scheme://bucket``, and what to check; without secrets."""
    text = str(error)
    if is_bucket_missing(error):
        return f"there is no bucket {bucket!r} at this endpoint; check its name, the region and the endpoint"
    if any(host in text for host in _METADATA_SERVICES) or "MissingAccount" in text:
        return f"no credentials were found; {_CREDENTIALS[scheme]}"
    if "without LOCATION" in text:
        return f"bucket {bucket!r} lies in another region; set {'AWS_REGION' if scheme == 's3' else 'the endpoint'}"
    status = _STATUS.search(text)
    return _network_reason(text) if status is None else _answer(text, status[1], bucket)


def _answer(text: str, status: str, bucket: str) -> str:
    """Return what a store meant that answered with ``status``."""
    code = _CODE.search(text)
    said = status if code is None else f"{status} {code[1]}"
    if status in ("401", "403"):
        return f"the store refuses access ({said}); check the credentials, and that they may read, write, list and delete in {bucket!r}"
    retries = _RETRIES.search(text)
    return f"the store answered {said}{f' to {int(retries[1]) + 1} requests' if retries else ''}; try again later"


def _network_reason(text: str) -> str:
    if "HTTP error" in text or "error sending request" in text:
        late = "did not answer in time" if "TimedOut" in text or "kind: Timeout" in text else "cannot be reached"
        host = _HOST.search(text)
        return f"the store{f' at {host[1]}' if host else ''} {late}; check the endpoint and the network"
    return _QUERY.sub("?...", text.partition("\n")[0])[:_LONGEST]
