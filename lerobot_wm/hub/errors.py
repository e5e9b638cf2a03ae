"""What goes wrong with the Hub, in one line."""

import re
from collections.abc import Iterator
from pathlib import Path

import httpx
from huggingface_hub import whoami
from huggingface_hub.errors import (
    EntryNotFoundError,
    HfHubHTTPError,
    HFValidationError,
    LocalTokenNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from lerobot.datasets.dataset_metadata import CODEBASE_VERSION
from lerobot.datasets.utils import get_repo_versions, is_valid_version
from packaging.version import Version

from lerobot_wm.data.source import dataset_folder, is_snapshot

LOGIN = "log in with `hf auth login`, or set HF_TOKEN"


class HubRefusalError(RuntimeError):
    """What the Hub is bound to refuse, found out before any work is done; its text is one line."""


def check_can_push(repo_id: str) -> None:
    """Make sure, before any work is done, that its result may be pushed.

    Raises:
        HubRefusalError: There is no token, or not one with which to write to the repository's namespace.
        HfHubHTTPError, ConnectionError: The Hub refuses the token, or cannot be reached.
    """
    try:
        user = whoami()
    except LocalTokenNotFoundError as error:
        raise HubRefusalError(
            f"pushing to {repo_id} needs a token with write access and there is none: {LOGIN}."
        ) from error
    if user["auth"].get("accessToken", {}).get("role") == "read":
        raise HubRefusalError(
            f"pushing to {repo_id} needs a token with write access, and {user['name']}'s may only read: "
            f"{LOGIN}, with another."
        )
    namespaces = [user["name"], *(organization["name"] for organization in user["orgs"])]
    owner = repo_id.split("/")[0] if "/" in repo_id else user["name"]
    if owner not in namespaces:
        raise HubRefusalError(
            f"{repo_id} belongs to {owner}, but the token is {user['name']}'s, who may write to "
            f"{', '.join(namespaces)}: push to {user['name']}/{repo_id.split('/')[1]}, or {LOGIN} as {owner}."
        )


def check_dataset_version(repo_id: str, root: str | Path | None, revision: str | None) -> None:
    """Refuse a dataset of the Hub without the version that is asked for, which LeRobot says in twenty lines.

    Args:
        repo_id: The dataset.
        root: Its folder, where it is on this machine; None looks where LeRobot does, which asks the Hub for the version
            of a dataset that it has downloaded, too.
        revision: As in `LeRobotDataset`; anything but a version such as v3.0 is left to it.

    Raises:
        HubRefusalError: It has no such version, or none at all.
        HfHubHTTPError, ConnectionError: There is no such dataset, or the Hub cannot be reached.
    """
    folder = dataset_folder(repo_id, root, revision)
    is_here = folder is not None and (root is not None or not is_snapshot(folder))
    if is_here or not is_valid_version(revision or CODEBASE_VERSION):
        return
    versions = sorted(get_repo_versions(repo_id))
    if not versions:
        raise HubRefusalError(
            f"dataset {repo_id} carries no version, such as {CODEBASE_VERSION}: its upload did not finish, or it is no "
            "LeRobot dataset. Push it again, or give --dataset.revision=main to read what is there."
        )
    if revision is not None and Version(revision) not in versions:
        raise HubRefusalError(
            f"dataset {repo_id} has no revision {revision!r}; it has the versions "
            f"{', '.join(f'v{version}' for version in versions)}: give one of them as --dataset.revision."
        )


def explain(error: BaseException) -> str | None:
    """What happened and how to mend it, where the Hub is at the bottom of an error; else None."""
    # The first refusal: what wraps it says less, and what it wraps is of httpx.
    return next((text for text in map(_explain_one, _chain(error)) if text is not None), None)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it came from, the origin last."""
    while error is not None:
        yield error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def _explain_one(error: BaseException) -> str | None:
    match error:
        case HubRefusalError():
            return str(error)
        case OfflineModeIsEnabled():
            return "the Hub is needed, but HF_HUB_OFFLINE is set: unset it, or give what is on this machine already."
        case LocalTokenNotFoundError():
            return f"the Hub asks for a token and there is none: {LOGIN}."
        case HFValidationError():
            return f"not a folder on this machine, and no name of a repository, user/name, either. {_one_line(error)}"
        case HfHubHTTPError():
            return _explain_answer(error)
        case httpx.TransportError():
            return (
                f"the connection to {error.request.url.host} broke off ({type(error).__name__}). A push that did not "
                "finish changes nothing there: run the command again; what has arrived is not sent twice."
            )
    return None


def _explain_answer(error: HfHubHTTPError) -> str:
    """The same for an answer of the Hub that is not the one hoped for."""
    url, status = str(error.response.url), error.response.status_code
    kind, repo_id, revision = _asked_for(url)
    match error:
        case RevisionNotFoundError():
            return (
                f"{kind} {repo_id} has no revision {revision!r}; expected one of its branches, tags or commits: "
                f"they are listed at {_page(error, kind, repo_id)}/commits/main."
            )
        case EntryNotFoundError():
            return f"{kind} {repo_id} has no such file ({url}): is it what you meant, and was its upload finished?"
        case RepositoryNotFoundError():
            return (
                f"there is no {kind} {repo_id} on the Hub, or it is private and this token may not read it ({status}): "
                f"check the name; for a private one {LOGIN}."
            )
    if status in (401, 403):
        return f"the Hub refuses ({status}, {_one_line(error.server_message or error)}): {LOGIN}, with write access."
    return f"the Hub answered {status} to {error.request.method} {url}: {_one_line(error.server_message or error)}"


def _asked_for(url: str) -> tuple[str, str, str | None]:
    """Kind of repository, its name and the revision in an address of the Hub."""
    path = httpx.URL(url).path
    match = re.match(
        r"/(?:api/)?(?P<kind>datasets/|models/)?(?P<repo_id>[^/]+/[^/]+)(?:/[a-z-]+/(?P<revision>[^/]+))?",
        path,
    )
    if match is None:
        return "repository", path, None
    kind = "dataset" if match["kind"] == "datasets/" else "model"
    return kind, match["repo_id"], match["revision"]


def _page(error: HfHubHTTPError, kind: str, repo_id: str) -> str:
    url = error.response.url
    prefix = "datasets/" if kind == "dataset" else ""
    return f"{url.scheme}://{url.netloc.decode()}/{prefix}{repo_id}"


def _one_line(text: object) -> str:
    return " ".join(str(text).split())
