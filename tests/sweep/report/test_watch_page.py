"""The page of `sweep watch --web`: who may see it, what stands on it, and how it changes beside a run."""

import base64
import hashlib
import json
import re
import signal
import socket
import time
from contextlib import closing
from html.parser import HTMLParser
from http.client import HTTPConnection
from urllib.parse import urlsplit
from wsgiref.util import setup_testing_defaults
from wsgiref.validate import validator

import pytest

from tests.sweep.opening import files_of
from tests.sweep.outside import wait_until
from tests.sweep.report.test_page import evil_store
from tests.sweep.report.test_page_in_browser import chromium, complaints, empty_page, pytestmark as in_browser, requests
from tests.tiers import PATIENCE_S

watch = pytest.importorskip("linksweep.sweep.report.page")
__all__ = ["chromium", "evil_store"]
SLOW = """
import time
def period(length: float, noise: float = 0.1, rng=None):
    time.sleep(0.001)
    if length > 1.9:
        raise ValueError("the string broke <b>here</b>")
    return length + rng.normal(0.0, noise)
"""


def ask(page, path, **request):
    answer = {}
    environ = {"PATH_INFO": path, "HTTP_HOST": "127.0.0.1:8000", "QUERY_STRING": "", "SCRIPT_NAME": ""} | request
    setup_testing_defaults(environ)

    def start(status, headers, *_error):
        answer.update(status=int(status[:3]), headers=dict(headers))

    response = validator(page)(environ, start)
    content = b"".join(response).decode()
    response.close()
    return answer["status"], answer["headers"], content


def names_in(text):
    names, reader = set(), HTMLParser()
    reader.handle_starttag = lambda tag, attrs: names.update({tag, *(name for name, _ in attrs)})
    reader.feed(text)
    return names


def test_only_who_knows_the_token_sees_the_page_whose_policy_names_its_scripts_and_nothing_else(coin_store):
    page = watch.Page([coin_store], 1.0)
    home = f"/{page.token}/"
    assert (len(page.token) >= 22, page.token == watch.Page([coin_store], 1.0).token) == (True, False)
    for path in ("/", "", "/state", home[:-2] + "/", home + "x", home + "../", 2 * home, home[:-1], home.lower()):
        assert ask(page, path)[::2] == (404, "")
    hosts = {"127.0.0.1:8000": 200, "localhost": 200, "evil.example:80": 403, "127.0.0.1.evil.example": 403, "": 403}
    for path in (home, home + "state"):
        assert {host: ask(page, path, HTTP_HOST=host)[0] for host in hosts} == hosts
        assert ask(page, path, HTTP_HOST="evil.example:80")[2] == ""
        assert ask(page, path, REQUEST_METHOD="POST")[::2] == (404, "")
    _, headers, content = ask(page, home)
    scripts = re.findall(r"<script>(.*?)</script>", content, flags=re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    policy = headers["Content-Security-Policy"]
    assert re.search(r"script-src ([^;]*)", policy)[1].split() == [f"'sha256-{digest}'" for digest in digests]
    assert {"default-src 'none'", "connect-src 'self'", "frame-ancestors 'none'"} <= set(policy.split("; "))
    assert "//" not in re.sub(r"<(script|style)>.*?</\1>", "", content, flags=re.DOTALL)


def test_every_text_of_a_store_is_escaped(evil_store, tmp_path):
    before = files_of(evil_store)
    page = watch.Page([evil_store, tmp_path / "<img src=x onerror='window.owned = true'>"], 0.2)
    for _ in range(2):  # figures come after the tiles
        parts = json.loads(ask(page, f"/{page.token}/state")[2])
        time.sleep(0.3)
    with page._lock:  # of a request for which a figure is drawn
        assert json.loads(ask(page, f"/{page.token}/state")[2]) == parts
    said = [("head-0", "&lt;script&gt;window.owned = true&lt;/script&gt;"), ("head-1", "waiting")]
    said += [("failures-0", "is what failed"), ("failures-0", "Traceback")]
    said += [("figure-0", "<svg")]  # the name of an axis value is no formula
    assert all(words in parts[part] for part, words in said)
    assert not [n for n in names_in("".join(parts.values())) if n in ("script", "img") or n.startswith("on")]
    assert files_of(evil_store) == before


@pytest.fixture
def beside(tmp_path, start_sweep):
    def start(*stores):
        process = start_sweep("watch", *stores, "--web", "--interval", "0.3", cwd=tmp_path)
        return process.stderr.readline().strip(), process

    return start


@pytest.mark.slow
def test_the_server_answers_on_loopback_alone(beside, tmp_path):
    address, process = beside("nowhere.zarr")
    url = urlsplit(address)
    assert url.hostname == "127.0.0.1"
    for host, wanted in (("localhost", 200), ("x.example", 403)):
        with closing(HTTPConnection("127.0.0.1", url.port, timeout=PATIENCE_S)) as connection:
            connection.request("GET", url.path, headers={"Host": host})
            assert connection.getresponse().status == wanted
    with pytest.raises(OSError, match="refused"):
        HTTPConnection("127.0.0.2", url.port, timeout=5).request("GET", "/")
    with socket.create_connection(("127.0.0.1", url.port)) as idle:
        idle.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    assert (process.wait(PATIENCE_S), process.stderr.read()) == (0, "Ctrl-C ends it\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@in_browser[1]
@pytest.mark.parametrize(("width", "theme"), [(1400, "light"), (390, "dark")])
def test_the_page_changes_beside_a_run(chromium, beside, evil_store, start_sweep, tmp_path, width, theme):
    empty_page(chromium, width, theme)
    (tmp_path / "f.py").write_text(SLOW)
    address, process = beside("s.zarr", evil_store)
    chromium.get(address)

    def wait_for(condition):
        wait_until(lambda: chromium.execute_script(f"return {condition}"), condition)

    first = "document.querySelector('#head-0')"
    wait_for(f"{first}.textContent.includes('waiting')")
    axes = ("--axis", "length=0.2:2:0.2", "--axis", "noise=0.1,0.2", "--set", "n_sim=300")
    running = start_sweep("run", "f.py:period", *axes, "--pool", "serial", "-o", "s.zarr", cwd=tmp_path)
    wait_for(f"{first}.textContent.includes('running')")
    wait_for("document.querySelectorAll('#tiles-0 i').length === 20")
    chromium.execute_script("window.tile = document.querySelector('#tiles-0 i')")
    wait_for("window.tile.className === 'done' && window.tile.isConnected")
    wait_for("document.querySelector('#figure-0 svg')")
    wait_for(f"{first}.textContent.includes('finished')")
    assert running.wait(PATIENCE_S) == 1
    wait_for("document.querySelector('#tiles-0 .tiles').ariaLabel === '18 of 20 points done, 2 failed'")
    assert "18 of 20 points done, 2 failed" in chromium.title
    details = chromium.find_element("css selector", "#failures-0 summary")
    assert details.text == "2 × ValueError: the string broke <b>here</b>"
    details.click()
    assert "period" in chromium.find_element("css selector", "#failures-0 pre").text
    chromium.find_elements("css selector", "#tiles-0 i")[-1].click()
    assert chromium.find_element("css selector", ".said").text == "length=2.0,noise=0.2: failed"
    wait_for("document.querySelector('#figure-1 svg')")  # whatever its names are
    assert chromium.execute_script("return document.documentElement.scrollWidth") <= width
    assert not chromium.execute_script("return window.owned")
    sent = requests(chromium)
    assert all(url.startswith(address) for url in sent if not url.startswith("data:")), sent
    assert complaints(chromium) == []
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 0
    wait_for("!document.querySelector('#ended').hidden")
