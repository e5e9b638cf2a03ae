"""A Hub on 127.0.0.1: the part of its HTTP interface that huggingface_hub and LeRobot use to push and to pull.

Repositories are kept in memory, file contents under their SHA-256 in a folder. A commit is a snapshot: path -> file.
Files reach a commit in the client's two ways, within the commit itself or ahead of it as large files (git LFS).
"""

import base64
import hashlib
import itertools
import json
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import yaml

LARGE = (".safetensors", ".parquet", ".mp4", ".webp")  # as the Hub's default .gitattributes has them
REPO = r"(?P<kind>model|dataset)s/(?P<repo_id>[\w.-]+/[\w.-]+)"
REPO_PAGE = r"/(?P<kind>datasets/)?(?P<repo_id>[\w.-]+/[\w.-]+)"


@dataclass(frozen=True)
class File:
    """A file of a commit; its content lies under `sha256`."""

    sha256: str
    size: int
    git_oid: str

    def listing(self, path: str) -> dict[str, Any]:
        entry = {"type": "file", "path": path, "size": self.size, "oid": self.git_oid}
        if path.endswith(LARGE):
            entry["lfs"] = {"oid": self.sha256, "size": self.size, "pointerSize": 134}
        return entry

    def etag(self, path: str) -> str:
        return self.sha256 if path.endswith(LARGE) else self.git_oid


@dataclass
class Repo:
    """A repository: its commits, and what its branches and tags point to."""

    private: bool
    commits: dict[str, dict[str, File]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def find(self, revision: str) -> str | None:
        """The commit that a branch, a tag or a commit's id means."""
        commit = self.branches.get(revision) or self.tags.get(revision) or revision
        return commit if commit in self.commits else None

    def files(self, revision: str = "main") -> dict[str, File]:
        return self.commits[self.find(revision)]


class Refusal(Exception):
    """An answer other than 200."""

    def __init__(self, status: int, message: str, code: str | None = None) -> None:
        super().__init__(message)
        self.status, self.code = status, code


class Hub:
    """The server's state, which tests may look at while it runs.

    Args:
        folder: for file contents.
        users: token -> name of its user; a token named `read-...` may not write.
    """

    def __init__(self, folder: Path, users: dict[str, str]) -> None:
        self.folder = folder
        self.users = users
        self.repos: dict[tuple[str, str], Repo] = {}
        self.url = ""  # set by `serve`
        self.requests: list[str] = []  # "METHOD path" of each
        self.hang_ups: list[str] = []  # regular expressions of requests to answer, once each, by hanging up
        self._numbers = itertools.count()
        self.lock = threading.Lock()

    def content(self, file: File) -> bytes:
        return (self.folder / file.sha256).read_bytes()

    def store(self, content: bytes) -> File:
        sha256 = hashlib.sha256(content).hexdigest()
        (self.folder / sha256).write_bytes(content)
        git_oid = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
        return File(sha256, len(content), git_oid)

    def commit(self, repo: Repo, branch: str, files: dict[str, File]) -> str:
        text = f"{next(self._numbers)} {sorted((path, file.sha256) for path, file in files.items())}"
        commit = hashlib.sha1(text.encode()).hexdigest()
        repo.commits[commit] = files
        repo.branches[branch] = commit
        return commit


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, *args: object) -> None:
        """Print nothing."""

    def do(self) -> None:
        url = urlsplit(self.path)
        path = unquote(url.path)
        request = f"{self.command} {path}"
        with self.hub.lock:
            self.hub.requests.append(request)
            hang_up = next((p for p in self.hub.hang_ups if re.search(p, request)), None)
            if hang_up is not None:
                self.hub.hang_ups.remove(hang_up)
        if hang_up is not None:
            self.rfile.read(1)  # in the middle of what the client sends
            self.close_connection = True
            return
        self.body = self.read_body()
        try:
            for method, pattern, answer in ROUTES:
                match = re.fullmatch(pattern, path)
                if match and self.command in method.split():
                    return answer(self, **match.groupdict())
            raise Refusal(404, f"no such route: {request}")
        except Refusal as refusal:
            headers = {"X-Error-Message": str(refusal)}
            if refusal.code:
                headers["X-Error-Code"] = refusal.code
            self.send(refusal.status, json.dumps({"error": str(refusal)}).encode(), headers)

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = do

    def read_body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        chunks = []
        while size := int(self.rfile.readline(), 16):
            chunks.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(chunks)

    def send(self, status: int, content: bytes, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def send_json(self, answer: Any) -> None:
        self.send(200, json.dumps(answer).encode(), {"Content-Type": "application/json"})

    @property
    def token(self) -> str | None:
        header = self.headers.get("Authorization")
        token = header.removeprefix("Bearer ") if header else None
        if token is not None and token not in self.hub.users:
            raise Refusal(401, "Invalid credentials in Authorization header")
        return token

    def check_write(self, owner: str) -> None:
        if self.token is None:
            raise Refusal(401, "Invalid username or password.")
        if self.hub.users[self.token] != owner or self.token.startswith("read-"):
            raise Refusal(403, f"You don't have the rights to write under the namespace {owner}.")

    def repo(self, kind: str | None, repo_id: str, write: bool = False) -> Repo:
        kind = "dataset" if kind and kind.startswith("dataset") else "model"
        owner = repo_id.split("/")[0]
        found = self.hub.repos.get((kind, repo_id))
        user = self.hub.users[self.token] if self.token else None
        if found is None or (found.private and user != owner):
            # As the Hub: without a token nobody learns whether a repository exists.
            raise Refusal(404 if user else 401, "Repository not found", "RepoNotFound")
        if write:
            self.check_write(owner)
        return found

    def commit_of(self, repo: Repo, revision: str) -> str:
        commit = repo.find(revision)
        if commit is None:
            raise Refusal(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        return commit

    # One method per route.

    def whoami(self) -> None:
        if self.token is None:
            raise Refusal(401, "Invalid username or password.")
        role = "read" if self.token.startswith("read-") else "write"
        auth = {"type": "access_token", "accessToken": {"displayName": "test", "role": role}}
        self.send_json({"type": "user", "name": self.hub.users[self.token], "orgs": [], "auth": auth})

    def validate_yaml(self) -> None:
        content = json.loads(self.body)["content"]
        match = re.match(r"---\n(.*?)\n---\n", content, re.DOTALL)
        try:
            metadata = yaml.safe_load(match[1]) if match else {}
        except yaml.YAMLError as error:
            return self.send(400, json.dumps({"errors": [{"message": str(error)}], "warnings": []}).encode())
        errors = [] if isinstance(metadata, dict) else [{"message": "metadata is no mapping"}]
        self.send(400 if errors else 200, json.dumps({"errors": errors, "warnings": []}).encode())

    def create(self) -> None:
        asked = json.loads(self.body)
        owner = asked["organization"] or (self.hub.users[self.token] if self.token else "")
        self.check_write(owner)
        kind, repo_id = asked.get("type", "model"), f"{owner}/{asked['name']}"
        prefix = "datasets/" if kind == "dataset" else ""
        url = {"url": f"http://{self.headers['Host']}/{prefix}{repo_id}"}
        if (kind, repo_id) in self.hub.repos:
            return self.send(409, json.dumps(url).encode())
        repo = self.hub.repos[kind, repo_id] = Repo(private=asked.get("visibility") == "private")
        self.hub.commit(repo, "main", {".gitattributes": self.hub.store(b"")})
        self.send_json(url)

    def info(self, kind: str, repo_id: str, revision: str | None = None) -> None:
        repo = self.repo(kind, repo_id)
        commit = self.commit_of(repo, revision or "main")
        files = [{"rfilename": path} for path in repo.commits[commit]]
        self.send_json({"id": repo_id, "sha": commit, "private": repo.private, "tags": [], "siblings": files})

    def refs(self, kind: str, repo_id: str) -> None:
        repo = self.repo(kind, repo_id)

        def listed(names: dict[str, str], folder: str) -> list[dict[str, str]]:
            return [
                {"name": name, "ref": f"refs/{folder}/{name}", "targetCommit": commit}
                for name, commit in names.items()
            ]

        branches, tags = listed(repo.branches, "heads"), listed(repo.tags, "tags")
        self.send_json({"branches": branches, "tags": tags, "converts": []})

    def tree(self, kind: str, repo_id: str, revision: str) -> None:
        repo = self.repo(kind, repo_id)
        files = repo.commits[self.commit_of(repo, revision)]
        self.send_json([file.listing(path) for path, file in files.items()])

    def paths_info(self, kind: str, repo_id: str, revision: str) -> None:
        repo = self.repo(kind, repo_id)
        files = repo.commits[self.commit_of(repo, revision)]
        paths = json.loads(self.body)["paths"]
        self.send_json([files[path].listing(path) for path in paths if path in files])

    def resolve(self, kind: str | None, repo_id: str, revision: str, path: str) -> None:
        repo = self.repo(kind, repo_id)
        commit = self.commit_of(repo, revision)
        file = repo.commits[commit].get(path)
        if file is None:
            headers = {"X-Error-Code": "EntryNotFound", "X-Repo-Commit": commit}
            return self.send(404, b"", headers)
        content, status = self.hub.content(file), 200
        headers = {"ETag": f'"{file.etag(path)}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes"}
        if asked := re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")):
            first, last = int(asked[1]), int(asked[2] or file.size - 1)
            headers["Content-Range"] = f"bytes {first}-{last}/{file.size}"
            content, status = content[first : last + 1], 206
        self.send(status, content, headers)

    def preupload(self, kind: str, repo_id: str, revision: str) -> None:
        repo = self.repo(kind, repo_id, write=True)
        known = repo.commits[self.commit_of(repo, revision)]
        answers = []
        for file in json.loads(self.body)["files"]:
            path = file["path"]
            answer = {"path": path, "uploadMode": "lfs" if path.endswith(LARGE) else "regular"}
            oid = known[path].etag(path) if path in known else None
            answers.append({**answer, "shouldIgnore": False, "oid": oid})
        self.send_json({"files": answers})

    def lfs_batch(self, kind: str | None, repo_id: str) -> None:
        self.repo(kind, repo_id, write=True)
        objects = json.loads(self.body)["objects"]
        for wanted in objects:
            if not (self.hub.folder / wanted["oid"]).exists():
                upload = {"href": f"http://{self.headers['Host']}/large-files/{wanted['oid']}"}
                wanted["actions"] = {"upload": upload}
        self.send_json({"transfer": "basic", "objects": objects})

    def put_large_file(self, oid: str) -> None:
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise Refusal(400, "content does not match its oid")
        self.hub.store(self.body)
        self.send(200, b"")

    def make_commit(self, kind: str, repo_id: str, revision: str) -> None:
        repo = self.repo(kind, repo_id, write=True)
        files = dict(repo.commits[self.commit_of(repo, revision)])
        for line in self.body.splitlines():
            item = json.loads(line)
            value = item["value"]
            if item["key"] == "file":
                files[value["path"]] = self.hub.store(base64.b64decode(value["content"]))
            elif item["key"] == "lfsFile":
                if not (self.hub.folder / value["oid"]).exists():
                    raise Refusal(400, f"{value['path']} was not uploaded")
                content = (self.hub.folder / value["oid"]).read_bytes()
                files[value["path"]] = self.hub.store(content)
        commit = self.hub.commit(repo, revision, files)
        prefix = "datasets/" if kind == "dataset" else ""
        url = f"http://{self.headers['Host']}/{prefix}{repo_id}/commit/{commit}"
        self.send_json({"commitUrl": url, "commitOid": commit, "success": True})

    def create_branch(self, kind: str, repo_id: str, name: str) -> None:
        repo = self.repo(kind, repo_id, write=True)
        start = json.loads(self.body or b"{}").get("startingPoint", "main")
        repo.branches[name] = self.commit_of(repo, start)
        self.send_json({})

    def create_tag(self, kind: str, repo_id: str, revision: str) -> None:
        repo = self.repo(kind, repo_id, write=True)
        tag = json.loads(self.body)["tag"]
        if tag in repo.tags:
            raise Refusal(409, "Tag reference exists already.")
        repo.tags[tag] = self.commit_of(repo, revision)
        self.send_json({})

    def delete_tag(self, kind: str, repo_id: str, name: str) -> None:
        repo = self.repo(kind, repo_id, write=True)
        if repo.tags.pop(name, None) is None:
            raise Refusal(404, f"Invalid rev id: {name}", "RevisionNotFound")
        self.send_json({})


ROUTES: list[tuple[str, str, Callable[..., None]]] = [
    ("GET", "/api/whoami-v2", Handler.whoami),
    ("POST", "/api/validate-yaml", Handler.validate_yaml),
    ("POST", "/api/repos/create", Handler.create),
    ("GET", f"/api/{REPO}", Handler.info),
    ("GET", f"/api/{REPO}/revision/(?P<revision>.+)", Handler.info),
    ("GET", f"/api/{REPO}/refs", Handler.refs),
    ("GET", f"/api/{REPO}/tree/(?P<revision>[^/]+)", Handler.tree),
    ("POST", f"/api/{REPO}/paths-info/(?P<revision>[^/]+)", Handler.paths_info),
    ("GET HEAD", rf"{REPO_PAGE}/resolve/(?P<revision>[^/]+)/(?P<path>.+)", Handler.resolve),
    ("POST", f"/api/{REPO}/preupload/(?P<revision>.+)", Handler.preupload),
    ("POST", rf"{REPO_PAGE}\.git/info/lfs/objects/batch", Handler.lfs_batch),
    ("PUT", r"/large-files/(?P<oid>\w+)", Handler.put_large_file),
    ("POST", f"/api/{REPO}/commit/(?P<revision>.+)", Handler.make_commit),
    ("POST", f"/api/{REPO}/branch/(?P<name>.+)", Handler.create_branch),
    ("POST", f"/api/{REPO}/tag/(?P<revision>.+)", Handler.create_tag),
    ("DELETE", f"/api/{REPO}/tag/(?P<name>.+)", Handler.delete_tag),
]


def serve(hub: Hub) -> ThreadingHTTPServer:
    """Serve a hub on a free port of 127.0.0.1, in threads of this process; `.shutdown()` ends it."""
    handler = type("HubHandler", (Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    hub.url = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server
