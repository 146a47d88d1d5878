"""The server of the page: what it answers, and whom it refuses."""

from __future__ import annotations

import hashlib
import io
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from PIL import Image

import valuemap
from small_dataset import ANCHOR, map_of
from valuemap.dataset import Frame
from valuemap.errors import InputError, OutputError
from valuemap.evidence import Evidence
from valuemap.geodesy import lon_lat_height_from_enu
from valuemap.map_folder import Map, write_map
from valuemap.tables import Categories, Rejected
from valuemap.tables.write import write_table
from valuemap.viewer.columns import pack_columns
from valuemap.viewer.details import place_details
from valuemap.viewer.scene import Scene
from valuemap.viewer.server import PAGE, Basemap, Content, ViewServer
from viewer_city import HOSTILE, part, street, write_city

SOURCES = Path(__file__).parent.parent / "viewer"


@dataclass
class Answer:
    status: int
    body: bytes
    headers: dict[str, str]

    def json(self) -> Any:
        return json.loads(self.body)


@dataclass
class Client:
    """Asks as the page does, unless told otherwise."""

    server: ViewServer

    def ask(
        self,
        path: str,
        *,
        method: str = "GET",
        host: str | None = None,
        token: str | None = None,
        body: bytes | None = None,
        headers: dict[str, str] | None = None,
    ) -> Answer:
        connection = HTTPConnection("127.0.0.1", self.server.port, timeout=30)
        given = self.server.token if token is None else token
        sent = {"Cookie": f"{self.server.cookie}={given}", **(headers or {})}
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        connection.putheader("Host", f"127.0.0.1:{self.server.port}" if host is None else host)
        for name, value in sent.items():
            connection.putheader(name, value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        reply: HTTPResponse = connection.getresponse()
        answer = Answer(reply.status, reply.read(), dict(reply.getheaders()))
        connection.close()
        return answer

    def get(self, path: str) -> Answer:
        answer = self.ask(path)
        assert answer.status == 200, (path, answer.body[:300])
        return answer

    def decide(self, wish: Any, **changed: str) -> Answer:
        origin = f"http://127.0.0.1:{self.server.port}"
        headers = {"Origin": origin, "Content-Type": "application/json", **changed}
        return self.ask("/api/reviews", method="POST", body=json.dumps(wish).encode(), headers=headers)


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Map]:
    folder = tmp_path_factory.mktemp("city")
    return folder, write_city(folder, "one", "two")


@pytest.fixture
def client(city: tuple[Path, Map], tmp_path: Path) -> Iterator[Client]:
    yield from serve(lambda: Scene(city[0] / "map"), tmp_path / "review.json")


def serve(read_scene: Any, review: Path, basemap: Basemap | None = None) -> Iterator[Client]:
    server = ViewServer(Content(read_scene, review), basemap=basemap)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield Client(server)
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def unpack(body: bytes) -> dict[str, NDArray[Any]]:
    """Read columns as the page does."""
    types = {"Float32Array": "<f4", "Float64Array": "<f8", "Int32Array": "<i4", "Uint8Array": "u1"}
    length = int.from_bytes(body[:4], "little")
    found = {}
    for each in json.loads(body[4 : 4 + length]):
        assert each["offset"] % 8 == 0
        flat = np.frombuffer(body, types[each["type"]], each["rows"] * each["width"], each["offset"])
        found[each["name"]] = flat if each["width"] == 1 else flat.reshape(each["rows"], each["width"])
    return found


# Who is answered


def test_the_page_comes_with_a_strict_policy_and_a_cookie(client: Client) -> None:
    page = client.ask(f"/?token={client.server.token}", token="")
    assert page.status == 200
    assert b"<main>" in page.body
    policy = page.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "https:" not in policy
    assert page.headers["Set-Cookie"].endswith("Path=/; HttpOnly; SameSite=Strict")
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert page.headers["Referrer-Policy"] == "no-referrer"
    # The page asks for nothing from elsewhere, and for nothing that is not there.
    html = page.body.decode()
    assert "http:" not in html
    assert "https:" not in html
    for asset in (rest.split('"')[0] for rest in html.split('="/')[1:]):
        assert client.ask(f"/{asset}").status == 200, asset


ENDPOINTS = [
    "/",
    "/index.html",
    "/icon.svg",
    "/api/map",
    "/api/labels",
    "/api/cameras",
    "/api/truth",
    "/api/rejected",
    "/api/reviews",
    "/api/label?id=1",
    "/api/place?east=0&north=0",
    "/api/crop?image=0&x=1&y=1&side=10",
    "/api/picture?image=0",
    "/nothing",
]


@pytest.mark.parametrize("path", ENDPOINTS)
def test_without_the_token_nothing_is_answered(client: Client, path: str) -> None:
    for token in ("", "wrong", client.server.token[:-1], "tökén"):
        sent = token.encode().decode("latin-1")
        assert client.ask(path, token=sent).status == 401
    assert client.ask("/?token=wrong").status == 401
    assert client.ask(path, token="").headers.get("Set-Cookie") is None


@pytest.mark.parametrize("path", ENDPOINTS)
def test_other_hosts_and_origins_are_refused(client: Client, path: str) -> None:
    port = client.server.port
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port}.evil.example", ""):
        assert client.ask(path, host=host).status == 403
    for origin in ("http://evil.example", f"https://127.0.0.1:{port}", "null", f"http://127.0.0.1:{port + 1}"):
        assert client.ask(path, headers={"Origin": origin}).status == 403
    for site in ("cross-site", "same-site"):
        assert client.ask(path, headers={"Sec-Fetch-Site": site, "Sec-Fetch-Mode": "no-cors"}).status == 403


def test_its_own_names_are_answered(client: Client) -> None:
    port = client.server.port
    assert (
        client.ask("/api/map", host=f"localhost:{port}", headers={"Origin": f"http://localhost:{port}"}).status == 200
    )
    assert (
        client.ask("/api/map", host=f"localhost:{port}", headers={"Origin": f"http://127.0.0.1:{port}"}).status == 403
    )


@pytest.mark.parametrize(
    "path",
    [
        "/../map/run.json",
        "/../../../../../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/..%2f..%2fetc/passwd",
        "/assets/../server.py",
        "/assets/%2e%2e/%2e%2e/server.py",
        "/assets/..\\..\\server.py",
        "//etc/passwd",
        "/etc/passwd",
        "/map/run.json",
        "/run.json",
        "/dataset/images/000.jpg",
        "/basemap.pmtiles",
        "/assets/",
        "/assets",
        "http://127.0.0.1/etc/passwd",
        "/api/picture?image=../../../../etc/passwd",
        "/api/picture?image=0&image=%2e%2e",
        "/api/crop?image=..%2f..&x=1&y=1&side=10",
        "/api/label?id=1%00",
        "/index.html%00.js",
        "/?/../../etc/passwd",
    ],
)
def test_no_path_leads_out(client: Client, path: str) -> None:
    answer = client.ask(path)
    if path.startswith("/?"):
        assert b"<main>" in answer.body
    else:
        assert answer.status in (400, 404), answer.body
    assert b"root:" not in answer.body
    assert b"ViewServer" not in answer.body


def test_pictures_outside_the_folder_are_not_shown(city: tuple[Path, Map], tmp_path: Path) -> None:
    """Names with `..` and absolute ones are refused; a link that leads out shows nothing, one inside is fine."""
    secret = tmp_path / "secret.jpg"
    Image.new("RGB", (40, 30)).save(secret)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    Image.new("RGB", (640, 480), (9, 99, 9)).save(pictures / "inside.jpg")
    (pictures / "link.jpg").symlink_to(secret)
    (pictures / "alias.jpg").symlink_to(pictures / "inside.jpg")
    folder = tmp_path / "data"
    dataset = street()
    images = pq.read_table(city[0] / "dataset" / "images.parquet")
    valuemap.write_dataset(dataset, folder)

    def rename(*new: str) -> None:
        names = [*new, *dataset.images.name.to_pylist()[len(new) :]]
        column = images.column_names.index("name")
        pq.write_table(images.set_column(column, "name", [names]), folder / "images.parquet")

    for outside in ("../secret.jpg", str(secret)):
        rename(outside)
        with pytest.raises(InputError, match="name"):
            Scene(city[0] / "map", dataset_folder=folder, pictures=pictures)
    rename("link.jpg", "alias.jpg")

    def read_scene() -> Scene:
        return Scene(city[0] / "map", dataset_folder=folder, pictures=pictures)

    for asked in serve(read_scene, tmp_path / "review.json"):
        statuses = [asked.ask(f"/api/picture?image={10 * i}").status for i in range(2)]
        crops = [asked.ask(f"/api/crop?image={10 * i}&x=20&y=20&side=20").status for i in range(2)]
        assert statuses == crops == [404, 200]


def test_changes_come_from_the_page_only(client: Client) -> None:
    wish = {"label_id": 1, "verdict": "rejected"}
    assert client.decide(wish, Origin="http://evil.example").status == 403
    assert client.decide(wish, **{"Content-Type": "text/plain"}).status == 415
    body = json.dumps(wish).encode()
    assert client.ask("/api/reviews", method="POST", body=body).status == 403
    origin = {"Origin": f"http://127.0.0.1:{client.server.port}", "Content-Type": "application/json"}
    assert client.ask("/api/map", method="POST", body=body, headers=origin).status == 404
    assert client.ask("/api/reviews", method="POST", body=b"{", headers=origin).status == 400
    assert client.ask("/api/reviews", method="POST", body=b"[" * 60_000, headers=origin).status == 400
    assert client.ask("/api/reviews", method="POST", body=b" " * 70_000, headers=origin).status == 413
    assert client.ask("/api/reviews", method="POST", headers=origin).status == 411
    assert client.ask("/api/reviews", method="PUT", body=body, headers=origin).status == 501
    assert client.get("/api/reviews").json() == {"decisions": [], "without_label": []}


# What is answered


def test_labels_and_cameras_are_those_of_the_map(client: Client, city: tuple[Path, Map]) -> None:
    labels, result = unpack(client.get("/api/labels").body), city[1]
    head = client.get("/api/map").json()
    assert head["counts"] == {
        "labels": len(result.labels),
        "gone": 0,
        "images": 120,
        "detections": len(street().detections),
    }
    assert head["classes"] == [HOSTILE]
    assert labels["id"].tolist() == result.labels.label_id.tolist()
    assert np.allclose(labels["position"] + head["origin"], result.labels.position_in_world_m, atol=1e-3)
    covariance = result.labels.covariance_m2
    assert np.allclose(labels["ellipse"][:, 0] ** 2 + labels["ellipse"][:, 1] ** 2, covariance[:, 0] + covariance[:, 3])
    assert np.allclose(labels["sigma_up"] ** 2, covariance[:, 5], rtol=1e-4)
    cameras = unpack(client.get("/api/cameras").body)
    assert len(cameras["position"]) == 120
    assert sorted(np.unique(cameras["pass"]).tolist()) == [0, 1]
    # A line leads on within a pass and never from one to another.
    ends = np.flatnonzero(np.diff(cameras["pass"]))
    assert cameras["joined"][ends].tolist() == [0] * len(ends)
    assert cameras["joined"][-1] == 0
    assert cameras["joined"].sum() > 100


def test_an_ellipse_is_turned_as_its_covariance(tmp_path: Path) -> None:
    """A major axis to the north-east in a frame whose up is y: east is x, north is... what the frame says."""
    result = map_of([[0, 0, 5]])
    covariance = np.array([[0.05, 0.04, 0.0, 0.05, 0.0, 0.01]])
    result = Map(result.frame, result.labels.replace(covariance_m2=covariance), result.votes, result.run)
    valuemap.write_map(result, tmp_path / "map")
    major, minor, angle = unpack(Scene(tmp_path / "map").labels_body)["ellipse"][0]
    assert (major, minor, angle) == pytest.approx((0.3, 0.1, np.pi / 4), abs=1e-6)
    in_world = replace(result, labels=result.labels.replace(absolute_covariance_m2=4.0 * covariance))
    valuemap.write_map(in_world, tmp_path / "in_world")
    major, minor, _ = unpack(Scene(tmp_path / "in_world").labels_body)["ellipse"][0]
    assert (major, minor) == pytest.approx((0.6, 0.2), abs=1e-6)


def test_a_label_says_what_it_rests_on(client: Client, city: tuple[Path, Map]) -> None:
    result = city[1]
    evidence = Evidence(result, street())
    label_id = int(result.labels.label_id[np.argmax(result.labels.votes)])
    details = client.get(f"/api/label?id={label_id}").json()
    voters, misses = evidence.voters(label_id), evidence.misses(label_id)
    assert details["class"] == HOSTILE
    assert [shot["name"] for shot in details["voters"]] == [evidence.image_name(int(row)) for row in voters.image_row]
    assert [shot["name"] for shot in details["misses"]] == [evidence.image_name(int(row)) for row in misses.image_row]
    assert np.allclose([shot["residual_px"] for shot in details["voters"]], voters.residual_px, atol=0.01)
    shot = details["voters"][0]
    assert shot["picture"] is True
    x, y, side = shot["crop"]
    crop = client.get(f"/api/crop?image={shot['image']}&x={x}&y={y}&side={side}")
    assert crop.headers["Content-Type"] == "image/jpeg"
    pixels = np.asarray(Image.open(io.BytesIO(crop.body))).astype(int)
    middle, corner = pixels[128, 128], pixels[8, 8]
    assert middle[0] > middle[1] + 80, "the lamp is in the middle of its crop"
    assert abs(corner[0] - 110) < 25
    whole = client.get(f"/api/picture?image={shot['image']}")
    assert Image.open(io.BytesIO(whole.body)).size == (640, 480)
    assert client.ask("/api/label?id=999999").status == 404
    assert client.ask("/api/label?id=x").status == 400
    assert client.ask("/api/crop?image=0&x=nan&y=1&side=10").status == 400
    assert client.ask("/api/crop?image=123456&x=1&y=1&side=10").status == 404


def test_an_empty_place_says_what_is_known(client: Client, city: tuple[Path, Map]) -> None:
    head = client.get("/api/map").json()
    labels = city[1].labels
    beside = labels.position_in_world_m[np.argmax(labels.votes), :2] + [1.5, 0.0]
    here = beside - head["origin"][:2]
    far = client.get("/api/place?east=5000&north=5000").json()
    assert "No image pictures this place" in far["answer"]
    details = client.get(f"/api/place?east={here[0]}&north={here[1]}").json()
    assert "No rejected hypothesis of this map is near" in details["answer"]
    assert f"{details['rays']} detections point" in details["answer"]
    assert details["looks"] > 0
    assert details["rays"] > 0
    assert details["labels"][0]["away_m"] == 1.5
    assert "show MAP" not in details["answer"]
    assert details["rays"] == details["free_rays"] + sum(taker["rays"] for taker in details["takers"])
    assert client.ask("/api/place?east=1e30&north=0").status == 400
    assert client.ask("/api/place?north=0").status == 400


def test_rejected_hypotheses_answer_why_a_place_is_empty(tmp_path: Path) -> None:
    write_city(tmp_path, "one", "two")
    rejected = Rejected(
        hypothesis_id=np.array([1, 2, 3]),
        class_name=Categories.from_texts(["light", "sign", "light"]),
        position_in_world_m=np.array([[31.0, 25.0, 5.0], [30.0, 24.0, 4.0], [90.0, 90.0, 5.0]]),
        votes=np.array([2, 7, 9]),
        passes=np.array([1, 2, 2]),
        expected=np.array([0, 30, 10]),
        existence=np.array([np.nan, 0.031, 0.5]),
        reason=Categories.from_texts(["votes", "existence", "merged"]),
        rival=np.array([-1, -1, 1]),
    )
    write_table(rejected, tmp_path / "map" / "rejected.parquet")
    for asked in serve(lambda: Scene(tmp_path / "map"), tmp_path / "review.json"):
        head = asked.get("/api/map").json()
        assert head["has"]["rejected"] is True
        assert len(unpack(asked.get("/api/rejected").body)["position"]) == 3
        east, north = 30.0 - head["origin"][0], 25.0 - head["origin"][1]
        details = asked.get(f"/api/place?east={east}&north={north}").json()
        assert [each["reason"] for each in details["rejected"]] == ["existence", "votes"]
        assert details["rejected"][0]["existence"] == 0.031
        assert details["rejected"][1]["existence"] is None
        assert "A hypothesis (sign) 1.00 m away had 7 votes of 2 passes" in details["answer"]
        assert details["position_m"][2] == 4.0
        nowhere = asked.get("/api/place?east=-400&north=-400").json()
        assert "No rejected hypothesis of this map is near" in nowhere["answer"]
        alone = Scene(tmp_path / "map")
        alone.evidence = None
        told = place_details(alone, east, north)["answer"]
        assert "A hypothesis (sign) 1.00 m away had 7 votes of 2 passes. It was rejected:" in told


def test_decisions_are_saved_at_once(client: Client, city: tuple[Path, Map]) -> None:
    first, second = (int(each) for each in city[1].labels.label_id[:2])
    path = client.server.content.opinions.path
    kept = client.decide({"label_id": first, "verdict": "rejected", "note": '"><script>alert(1)</script>'})
    assert kept.status == 200
    assert kept.json()["state"] == "rejected"
    assert json.loads(path.read_text())["decisions"][0]["note"] == '"><script>alert(1)</script>'
    moved = client.decide({"label_id": second, "verdict": "accepted", "moved_to": [1.5, -2.0], "new_class": "sign"})
    assert moved.json()["moved_to"] == [1.5, -2.0]
    states = {each["label_id"]: each["state"] for each in client.get("/api/reviews").json()["decisions"]}
    assert states == {first: "rejected", second: "accepted"}
    assert client.decide({"label_id": first, "verdict": "accepted"}).json()["state"] == "accepted"
    assert len(json.loads(path.read_text())["decisions"]) == 2
    assert client.decide({"label_id": first, "verdict": None}).json() == {"label_id": first, "state": "open"}
    assert [each["label_id"] for each in json.loads(path.read_text())["decisions"]] == [second]
    # A server that starts again knows it.
    assert [
        each["label_id"] for each in Content(lambda: client.server.content.scene, path).opinions.to_json()["decisions"]
    ] == [second]


@pytest.mark.parametrize(
    "wish",
    [
        [],
        {"label_id": 999_999, "verdict": "rejected"},
        {"label_id": "1", "verdict": "rejected"},
        {"label_id": True, "verdict": "rejected"},
        {"label_id": 10**30, "verdict": "rejected"},
        {"label_id": 1, "verdict": "maybe"},
        {"label_id": 1, "verdict": ["rejected"]},
        {"label_id": 1, "verdict": "accepted", "moved_to": [1]},
        {"label_id": 1, "verdict": "accepted", "moved_to": [1, 1e300]},
        {"label_id": 1, "verdict": "accepted", "moved_to": "here"},
        {"label_id": 1, "verdict": "accepted", "note": 7},
        {"label_id": 1, "verdict": "accepted", "note": "x" * 3000},
        {"label_id": 1, "verdict": "accepted", "new_class": {"a": 1}},
        {"label_id": 1, "verdict": "rejected", "newclass": "sign"},
        {"label_id": 1, "verdict": "rejected", "comment": "a bin", "by": "me"},
    ],
)
def test_wishes_that_make_no_sense_change_nothing(client: Client, wish: Any) -> None:
    answer = client.decide(wish)
    assert answer.status == 400
    assert len(answer.json()["error"].splitlines()) == 1
    assert not client.server.content.opinions.path.exists()


def test_a_map_that_is_made_again_is_shown_with_its_decisions(tmp_path: Path) -> None:
    before = write_city(tmp_path, "one")
    for asked in serve(lambda: Scene(tmp_path / "map"), tmp_path / "map" / "review.json"):
        rejected = int(before.labels.label_id[np.argmax(before.labels.votes)])
        place = before.labels.position_in_world_m[np.argmax(before.labels.votes)]
        assert asked.decide({"label_id": rejected, "verdict": "rejected"}).status == 200
        after = write_city(tmp_path, "one", "two")
        asked.get("/")  # A page that is loaded again asks for labels before it knows anything.
        assert unpack(asked.get("/api/labels").body)["votes"].tolist() == after.labels.votes.tolist()
        assert asked.get("/api/map").json()["counts"]["images"] == 120
        (again,) = asked.get("/api/reviews").json()["decisions"]
        assert again["state"] == "rejected"
        row = int(np.searchsorted(after.labels.label_id, again["label_id"]))
        assert after.labels.votes[row] > before.labels.votes.max()
        assert np.linalg.norm(after.labels.position_in_world_m[row] - place) < 0.3


def test_a_rejected_label_with_twice_the_votes_is_to_be_checked_again(tmp_path: Path) -> None:
    before = write_city(tmp_path, "two")
    row = int(np.argmax(before.labels.votes))
    for asked in serve(lambda: Scene(tmp_path / "map"), tmp_path / "map" / "review.json"):
        assert asked.decide({"label_id": int(before.labels.label_id[row]), "verdict": "rejected"}).status == 200
        write_city(tmp_path, "one", "two")
        asked.get("/api/map")
        (again,) = asked.get("/api/reviews").json()["decisions"]
        assert (again["state"], again["votes_then"]) == ("check again", int(before.labels.votes[row]))


def test_a_label_beside_a_rejected_one_is_asked_about_until_somebody_decides(tmp_path: Path) -> None:
    write_map(map_of([[0, 0, 5], [30, 0, 5]]), tmp_path / "map")
    for asked in serve(lambda: Scene(tmp_path / "map"), tmp_path / "map" / "review.json"):
        assert asked.decide({"label_id": 0, "verdict": "rejected"}).status == 200
        write_map(map_of([[0.3, 0, 5], [-0.4, 0, 5], [30, 0, 5]]), tmp_path / "map")
        asked.get("/api/map")
        said = {each["label_id"]: each for each in asked.get("/api/reviews").json()["decisions"]}
        assert said[0]["state"] == "rejected"
        assert said[1] == {"label_id": 1, "state": "check again", "beside": 0}
        assert asked.decide({"label_id": 1, "verdict": "accepted"}).json()["state"] == "accepted"
        assert asked.decide({"label_id": 1, "verdict": None}).json() == said[1]
        # Without the rejection there is nothing to ask.
        asked.decide({"label_id": 0, "verdict": "accepted"})
        assert [each["label_id"] for each in asked.get("/api/reviews").json()["decisions"]] == [0]


def test_what_is_missing_is_said(city: tuple[Path, Map], tmp_path: Path) -> None:
    """A map alone: numbers without votes; a dataset without pictures: boxes without pictures."""
    valuemap.write_map(city[1], tmp_path / "alone" / "map")
    scene = Scene(tmp_path / "alone" / "map")
    assert scene.evidence is None
    assert "dataset of this map was not found" in scene.notes[0]
    for asked in serve(lambda: scene, tmp_path / "review.json"):
        details = asked.get("/api/label?id=1").json()
        assert details["voters"] == details["misses"] == []
        assert "looks" not in asked.get("/api/place?east=0&north=0").json()
        assert len(unpack(asked.get("/api/cameras").body)["position"]) == 0
    dataset = tmp_path / "bare"
    valuemap.write_dataset(street(), dataset)
    bare = Scene(city[0] / "map", dataset_folder=dataset)
    assert bare.pictures is None
    assert "no pictures" in bare.notes[0]
    with pytest.raises(InputError, match="is not in the dataset"):
        Scene(city[0] / "map", dataset_folder=write_part(tmp_path / "part"))
    with pytest.raises(InputError, match="is not a folder"):
        Scene(city[0] / "map", pictures=tmp_path / "nowhere")
    with pytest.raises(InputError, match="no such file or folder"):
        Scene(city[0] / "map", truth=tmp_path / "nowhere.csv")


def write_part(folder: Path) -> Path:
    valuemap.write_dataset(part(street(), "one"), folder)
    return folder


def test_truth_says_what_became_of_labels(tmp_path: Path) -> None:
    valuemap.write_map(map_of([[0, 0, 5], [20, 0, 5]], ["light", "light"]), tmp_path / "map")
    (tmp_path / "truth.csv").write_text("x,y,z,class\n0.1,0,5,light\n40,0,5,light\n")
    columns = unpack(Scene(tmp_path / "map", truth=tmp_path / "truth.csv").truth_body)
    outcomes = ("", "true", "duplicate", "false", "gone", "found", "missed", "not recoverable")
    assert [outcomes[each] for each in columns["outcome"]] == ["found", "missed"]
    assert [outcomes[each] for each in columns["label_outcome"]] == ["true", "false"]


def test_a_geo_referenced_map_says_latitude_and_longitude(tmp_path: Path) -> None:
    place = np.array([[10.0, 20.0, 5.0]])
    lon_lat_height = lon_lat_height_from_enu(place, ANCHOR)
    valuemap.write_map(map_of(place, frame=Frame(anchor=ANCHOR), lon_lat_height=lon_lat_height), tmp_path / "map")
    for asked in serve(lambda: Scene(tmp_path / "map"), tmp_path / "review.json"):
        assert asked.get("/api/map").json()["anchor"] == {"lat": 51.5, "lon": -0.14, "height": 35.0}
        assert asked.get("/api/label?id=0").json()["lon_lat_height"] == pytest.approx(lon_lat_height[0])


def test_an_empty_map_is_shown(tmp_path: Path) -> None:
    valuemap.write_map(map_of([]), tmp_path / "map")
    for asked in serve(lambda: Scene(tmp_path / "map"), tmp_path / "review.json"):
        assert asked.get("/api/map").json()["counts"]["labels"] == 0
        assert "keeps no rejected" in asked.get("/api/place?east=0&north=0").json()["answer"]


def test_tiles_of_a_basemap_are_served_in_ranges(city: tuple[Path, Map], tmp_path: Path) -> None:
    tiles = tmp_path / "region.pmtiles"
    tiles.write_bytes(bytes(range(256)) * 4)
    for asked in serve(lambda: Scene(city[0] / "map"), tmp_path / "r.json", Basemap.from_text(str(tiles))):
        assert asked.get("/api/map").json()["basemap"] == {"tiles": "/basemap.pmtiles"}
        some = asked.ask("/basemap.pmtiles", headers={"Range": "bytes=256-259"})
        assert (some.status, some.body) == (206, bytes(range(4)))
        assert some.headers["Content-Range"] == "bytes 256-259/1024"
        assert asked.ask("/basemap.pmtiles", headers={"Range": "bytes=1020-9999"}).body == bytes(range(252, 256))
        for bad in ("bytes=2000-", "bytes=-5", "bytes=5-2", "lines=1-2", ""):
            assert asked.ask("/basemap.pmtiles", headers={"Range": bad}).status == 416
    style = Basemap.from_text("https://tiles.example/style.json")
    for asked in serve(lambda: Scene(city[0] / "map"), tmp_path / "r.json", style):
        assert "connect-src 'self' https:;" in asked.get("/").headers["Content-Security-Policy"]
    with pytest.raises(InputError, match="neither"):
        Basemap.from_text(str(tmp_path / "absent.pmtiles"))


def test_a_port_in_use_is_one_line(client: Client, city: tuple[Path, Map], tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=f"port {client.server.port} of 127.0.0.1 cannot be used"):
        ViewServer(Content(lambda: client.server.content.scene, tmp_path / "r.json"), port=client.server.port)


def test_columns_are_aligned_whatever_their_lengths() -> None:
    columns: dict[str, NDArray[Any]] = {
        "a": np.arange(3, dtype=np.uint8),
        "b": np.arange(6, dtype=np.float64).reshape(3, 2),
        "c": np.empty((0, 3), np.float32),
        "d": np.arange(5, dtype=np.int32),
    }
    found = unpack(pack_columns(columns))
    assert list(found) == list(columns)
    for name, values in columns.items():
        assert np.array_equal(found[name], values)


# The command line


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "valuemap", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_view_and_export_from_the_command_line(city: tuple[Path, Map], tmp_path: Path) -> None:
    assert command("view", tmp_path).stderr.startswith("error: ")
    assert command("export", city[0] / "map", tmp_path / "a.csv", "--reviewed").stderr.startswith("error: ")
    review = tmp_path / "review.json"
    running = subprocess.Popen(
        [sys.executable, "-m", "valuemap", "view", city[0] / "map", "--no-open", "--review", review],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stdout is not None
    address = running.stdout.readline().strip()
    port, token = address.removeprefix("http://127.0.0.1:").split("/?token=")
    connection = HTTPConnection("127.0.0.1", int(port), timeout=30)
    cookie = {"Cookie": f"valuemap-{port}={token}"}
    wish = {"label_id": int(city[1].labels.label_id[0]), "verdict": "rejected"}
    headers = {**cookie, "Origin": f"http://127.0.0.1:{port}", "Content-Type": "application/json"}
    connection.request("POST", "/api/reviews", json.dumps(wish), headers)
    reply = connection.getresponse()
    reply.read()
    connection.close()
    running.terminate()
    told = running.communicate(timeout=30)
    assert reply.status == 200
    assert (running.returncode, told[0]) == (0, "")
    assert "Traceback" not in told[1]
    assert "SIGTERM" not in told[1]
    done = command("export", city[0] / "map", tmp_path / "a.csv", "--review", review)
    assert done.returncode == 0, done.stderr
    assert "1 rejected and left out" in done.stderr
    assert len((tmp_path / "a.csv").read_text().splitlines()) == len(city[1].labels)


# The built page


def test_the_page_is_built_from_the_sources_here() -> None:
    recorded = (PAGE / "built_from.txt").read_text().strip()
    digest = hashlib.sha256()
    files = ["index.html", "package.json", "package-lock.json", "vite.config.ts", "tsconfig.json"]
    files += [
        path.relative_to(SOURCES).as_posix() for name in ("src", "public") for path in (SOURCES / name).rglob("*")
    ]
    for name in sorted(files):
        if (SOURCES / name).is_file():
            digest.update(f"{name}\0".encode() + (SOURCES / name).read_bytes() + b"\0")
    assert recorded == digest.hexdigest(), "build the page again: npm ci && npm run build in viewer/"
