"""In a real browser: the token's link, and what a page of another origin can do to the panel."""

import json
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from galen_panel.options import new_token
from panel_processes import PanelWorld
from selenium.webdriver.common.by import By

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

TOKEN = new_token()

# Tries all a page may try, and tells what got through.
ATTACK = """
<!doctype html><title>evil</title><a id="link" href="PANEL">look here</a><div id="told"></div>
<script>
const tried = {};
const load = (name, element, attribute, address) => new Promise(resolve => {
  element[attribute] = address;
  element.onload = () => { tried[name] = 'loaded'; resolve(); };
  element.onerror = () => { tried[name] = 'rejected'; resolve(); };
  document.body.append(element);
});
const get = (name, options) => fetch('PANEL', options)
  .then(answer => { tried[name] = answer.type == 'opaque' ? 'opaque' : answer.status; })
  .catch(() => { tried[name] = 'rejected'; });
const socket = new Promise(resolve => {
  const one = new WebSocket('PANEL'.replace('http', 'ws').replace(/\\/[^/]*$/, '')
    + '/_nicegui_ws/socket.io/?EIO=4&transport=websocket');
  one.onopen = () => { tried.socket = 'open'; resolve(); };
  one.onerror = () => { tried.socket = 'rejected'; resolve(); };
});
const framed = new Promise(resolve => {
  const frame = document.createElement('iframe');
  frame.src = 'PANEL';
  frame.onload = resolve;
  document.body.append(frame);
});
Promise.all([
  load('image', document.createElement('img'), 'src', 'PANEL'.replace(/[?].*/, '') + 'favicon.ico'),
  load('script', document.createElement('script'), 'src', 'PANEL'),
  get('read', {}), get('blind', {mode: 'no-cors', credentials: 'include'}),
  get('post', {method: 'POST', mode: 'no-cors', credentials: 'include', body: 'x'}),
  socket, framed,
]).then(() => { document.getElementById('told').textContent = JSON.stringify(tried); });
</script>
"""


@contextmanager
def page_of_another_origin(text):
    """Serve one page; yields its port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200 if self.path == "/" else 404)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode() if self.path == "/" else b"")

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture(scope="module")
def open_link(tmp_path_factory):
    with PanelWorld(tmp_path_factory.mktemp("open")) as world:
        yield world.start_panel(fake=True)


@pytest.fixture(scope="module")
def closed_link(tmp_path_factory):
    with PanelWorld(tmp_path_factory.mktemp("closed")) as world:
        yield world.start_panel(fake=True, GALEN_PANEL_TOKEN=TOKEN)


def test_the_link_with_the_token_leads_to_a_page_that_works(browser, closed_link):
    browser.open(closed_link)
    connected(browser)
    assert TOKEN not in browser.driver.current_url
    assert browser.script("return document.cookie") == ""
    cookies = browser.driver.get_cookies()
    assert [(one["value"], one["httpOnly"], one["sameSite"]) for one in cookies] == [
        (TOKEN, True, "Lax")
    ]
    browser.driver.refresh()
    connected(browser)


def test_without_the_token_there_is_a_sentence_that_says_what_to_do(chromium, closed_link):
    chromium.forget()
    chromium.open(closed_link.split("?")[0])
    body = chromium.driver.find_element(By.TAG_NAME, "body").text
    assert body == "The panel needs its token: open it with the whole link that it printed when" + (
        " it started."
    )
    # With the link it then works: nothing of the rejections is kept.
    chromium.open(closed_link)
    connected(chromium)


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1"])
def test_a_page_of_another_origin_gets_nowhere(chromium, open_link, name):
    """Of another site by `localhost`, of the same with another port by the number."""
    attack(chromium, open_link, name)


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1"])
def test_nor_with_the_cookie_in_the_same_browser(chromium, closed_link, name):
    chromium.forget()
    chromium.open(closed_link)
    connected(chromium)
    attack(chromium, closed_link.split("?")[0], name, forget=False)


def attack(browser, link, name, forget=True):
    if forget:
        browser.forget()
    with page_of_another_origin(ATTACK.replace("PANEL", link)) as port:
        browser.open(f"http://{name}:{port}/")
        told = browser.wait(
            lambda: browser.driver.find_element(By.ID, "told").text, "the attack to be over"
        )
        tried = json.loads(told)
        assert len(tried) == 6 and set(tried.values()) == {"rejected"}, tried
        browser.driver.switch_to.frame(0)
        assert "nicegui" not in browser.driver.page_source.lower()
        browser.driver.switch_to.default_content()


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1"])
def test_a_link_on_another_page_opens_the_panel(chromium, closed_link, name):
    """As in a chat or a wiki, where the link was put."""
    chromium.forget()
    with page_of_another_origin(f'<a id="link" href="{closed_link}">the panel</a>') as port:
        chromium.open(f"http://{name}:{port}/")
        chromium.driver.find_element(By.ID, "link").click()
        connected(chromium)
        assert TOKEN not in chromium.driver.current_url


def connected(browser):
    """Wait until the page shows its tabs and has its socket."""
    browser.find("tab-operate")
    browser.wait(lambda: browser.script("return window.socket?.connected"), "the page's socket")
