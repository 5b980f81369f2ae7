"""A real browser for tests: Chromium, driven over the WebDriver protocol (W3C) by chromedriver."""

import base64
import re
import shutil
import subprocess
from contextlib import contextmanager

import pytest
import requests

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
DRIVER = shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    CHROMIUM is None or DRIVER is None,
    reason="needs Chromium: apt-get install chromium chromium-driver",
)


class Browser:
    """One window. ``do`` runs JavaScript in the page."""

    def __init__(self, session):
        self._session = session

    def _post(self, path, **content):
        answer = requests.post(f"{self._session}/{path}", json=content, timeout=120).json()["value"]
        if isinstance(answer, dict) and "error" in answer:
            raise AssertionError(f"{path}: {answer['message']}")
        return answer

    def open(self, path):
        self.open_url(path.as_uri())

    def open_url(self, url):
        self._post("url", url=url)

    def do(self, script):
        return self._post("execute/sync", script=script, args=[])

    def wait_for(self, condition):
        """Waits until an expression in the page is true, and returns its value."""
        look = f"const is = {condition}; is ? arguments[0](is) : setTimeout(look, 20, arguments[0])"
        wait = f"function look() {{ {look} }}; look(arguments[0]);"
        return self._post("execute/async", script=wait, args=[])

    def press(self, *keys):
        """Presses keys, each a character or a code point of WebDriver's, such as ``ENTER``."""
        actions = [{"type": t, "value": k} for k in keys for t in ("keyDown", "keyUp")]
        self._post("actions", actions=[{"type": "key", "id": "k", "actions": actions}])

    def complaints(self):
        """What the console has said since it was last asked."""
        said = [entry["message"] for entry in self._post("se/log", type="browser")]
        return [message for message in said if "GL Driver Message" not in message]

    def set_dark(self, dark):
        feature = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._post(
            "goog/cdp/execute", cmd="Emulation.setEmulatedMedia", params={"features": [feature]}
        )

    def screenshot(self, path):
        """Saves a picture of the window."""
        shot = requests.get(f"{self._session}/screenshot", timeout=120).json()["value"]
        path.write_bytes(base64.b64decode(shot))


ENTER, TAB, ESCAPE = "\ue007", "\ue004", "\ue00c"


@contextmanager
def browser(width=1280, height=900):
    """Starts Chromium with a window of this size [pixel]; a narrow one is a phone's."""
    process = subprocess.Popen(
        [DRIVER, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        port = next(
            m[1] for line in process.stdout if (m := re.search(r"successfully on port (\d+)", line))
        )
        options = {
            "binary": CHROMIUM,
            "args": ["--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader"],
            "mobileEmulation": {"deviceMetrics": {"width": width, "height": height,
                                                  "pixelRatio": 1, "mobile": width < 600}},
        }  # fmt: skip
        wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL"}}
        server = f"http://127.0.0.1:{port}/session"
        started = requests.post(
            server, json={"capabilities": {"alwaysMatch": wanted}}, timeout=120
        ).json()["value"]
        session = f"{server}/{started['sessionId']}"
        try:
            yield Browser(session)
        finally:
            requests.delete(session, timeout=60)
    finally:
        process.terminate()
        process.wait()
