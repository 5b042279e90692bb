# SPDX-License-Identifier: Apache-2.0
"""A real Chromium: finds by data-testid, waits on predicates, and tells what a page asked for."""

import json
import shutil
from contextlib import suppress
from urllib.parse import urlsplit

from selenium import webdriver
from selenium.common.exceptions import (
    ElementNotInteractableException,
    StaleElementReferenceException,
    TimeoutException,
)
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

CHROMIUM = shutil.which("chromium")
CHROMEDRIVER = shutil.which("chromedriver")
PATIENCE_S = 60.0
_POLL_S = 0.05
_OWN_SCHEMES = ("data", "blob", "about", "chrome", "chrome-extension", "devtools")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",  # root has no other way
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--no-first-run",
    "--force-prefers-reduced-motion",
    "--lang=en-US",
)
# Without a graphics card drawing in three dimensions takes as much time as there is.
_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_NO_WEBGL = ("--disable-gpu", "--disable-3d-apis")


class Browser:
    """One Chromium with one window; `close` ends it. What it downloads goes to `folder`."""

    def __init__(self, folder, width=1400, height=1000, webgl=False):
        self.folder = folder
        self._webgl = webgl
        drawing = _WEBGL if webgl else _NO_WEBGL
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        for flag in (*_FLAGS, *drawing, f"--window-size={width},{height}"):
            options.add_argument(flag)
        options.add_experimental_option("prefs", {"download.default_directory": str(folder)})
        options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
        self.driver = webdriver.Chrome(options=options, service=Service(CHROMEDRIVER))
        self._allowed = set()
        self._foreign = []
        self._errors = []

    def close(self):
        self.driver.quit()

    def forget(self):
        """Begin anew: an empty page, no cookies, nothing complained of."""
        self.driver.get("about:blank")
        self.driver.execute_cdp_cmd("Network.clearBrowserCookies", {})
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
        self.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        self._read_logs()
        self._allowed, self._foreign, self._errors = set(), [], []

    def open(self, link):
        """Open a link; requests to its host are from then on no foreign ones."""
        self._allowed.add(urlsplit(link).netloc)
        self.driver.get(link)

    def prefer(self, scheme):
        """As the system's setting: dark or light."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def resize(self, width, height):
        """The page's own size, in px, until `forget`; a window would not be as narrow."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)

    # looking

    def wait(self, predicate, what, patience_s=PATIENCE_S):
        """Until `predicate()` is true; an element that goes away meanwhile counts as not yet."""
        waiting = WebDriverWait(
            self.driver, patience_s, _POLL_S, ignored_exceptions=[StaleElementReferenceException]
        )
        try:
            return waiting.until(lambda _: predicate())
        except TimeoutException:
            raise AssertionError(f"waited {patience_s} s in vain for {what}") from None

    def all(self, testid):
        """The elements of this id that can be seen now."""
        found = self.driver.find_elements(By.CSS_SELECTOR, f'[data-testid="{testid}"]')
        return [element for element in found if element.is_displayed()]

    def find(self, testid, patience_s=PATIENCE_S):
        """The one of this id, as soon as it can be seen."""
        return self.wait(lambda: self.all(testid), f"[data-testid={testid}]", patience_s)[0]

    def text(self, testid):
        return self.find(testid).text

    def says(self, testid, *words, patience_s=PATIENCE_S):
        """Wait until its text has all these words; returns the text."""

        def look():
            texts = [element.text for element in self.all(testid)]
            return next((text for text in texts if all(word in text for word in words)), None)

        try:
            return self.wait(look, f"{testid} to say {words}", patience_s)
        except AssertionError as error:
            said = [element.text for element in self.all(testid)]
            page = self.script("return document.body.innerText")
            raise AssertionError(f"{error}; it says {said}, and the whole page:\n{page}") from None

    def usable(self, testid):
        """Whether it is there and not disabled."""
        return any(
            element.is_enabled() and element.get_attribute("aria-disabled") != "true"
            for element in self.all(testid)
        )

    def focus(self):
        """The data-testid that has the keyboard's focus, itself or around what has it."""
        return self.script(
            "return document.activeElement?.closest('[data-testid]')?.dataset.testid ?? ''"
        )

    def script(self, text, *arguments):
        return self.driver.execute_script(text, *arguments)

    def run(self, text, *arguments):
        """Script that ends by calling `done(value)`."""
        return self.driver.execute_async_script(
            f"const done = arguments[arguments.length - 1]; {text}", *arguments
        )

    # doing

    def click(self, testid):
        """As soon as it can be clicked; it may have gone since it was looked at, and come again."""

        def clicked():
            for element in self.all(testid) if self.usable(testid) else []:
                self.script("arguments[0].scrollIntoView({block: 'center'})", element)
                with suppress(ElementNotInteractableException):
                    element.click()
                    return True
            return False

        self.wait(clicked, f"{testid} to be clicked")

    def type(self, testid, text):
        """Into the field of this id, instead of what is there."""
        field = self.find(testid)
        if field.tag_name != "input":
            field = field.find_element(By.TAG_NAME, "input")
        self.script("arguments[0].select()", field)
        field.send_keys(text)

    def choose(self, testid, text):
        """An entry of a list that opens."""
        self._entry(testid, text).click()
        self.wait(lambda: not self._lists(), f"the list of {testid} to close")

    def choose_several(self, testid, *texts):
        """Entries of a list that stays open until Escape."""
        for text in texts:
            self._entry(testid, text).click()
        self.press("\ue00c")
        self.wait(lambda: not self._lists(), f"the list of {testid} to close")

    def _entry(self, testid, text):
        def opened():
            entries = self.driver.find_elements(By.CSS_SELECTOR, ".q-menu .q-item")
            found = next((one for one in entries if text in one.text), None)
            lists = self._lists()
            # A page that is just changing closes it again.
            if found is None and not lists:
                self.click(testid)
            # Quasar gives up to place a list that is not drawn within 60 ms.
            elif any(one.value_of_css_property("visibility") == "hidden" for one in lists):
                self.press("\ue00c")
            return found

        return self.wait(opened, f"the entry {text} of {testid}")

    def _lists(self):
        return self.driver.find_elements(By.CSS_SELECTOR, ".q-menu")

    def hover(self, testid):
        """As a mouse that rests on it."""
        webdriver.ActionChains(self.driver).move_to_element(self.find(testid)).perform()

    def press(self, *keys):
        """Keys to whatever has the focus."""
        webdriver.ActionChains(self.driver).send_keys(*keys).perform()

    # what it did

    def screenshot(self, path):
        self.driver.save_screenshot(str(path))
        return path

    def foreign_requests(self):
        """Addresses that were asked for since `forget`, of other hosts than those opened."""
        self._read_logs()
        return self._foreign

    def console_errors(self):
        """What the console called an error since `forget`."""
        self._read_logs()
        return self._errors

    def forgive(self, words):
        """Leave the page; errors of the console with these words were expected."""
        self.driver.get("about:blank")
        self._read_logs()
        self._errors = [text for text in self._errors if words not in text]

    def _read_logs(self):
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] == "Network.requestWillBeSent":
                address = message["params"]["request"]["url"]
            elif message["method"] == "Network.webSocketCreated":
                address = message["params"]["url"]
            else:
                continue
            parts = urlsplit(address)
            if parts.scheme not in _OWN_SCHEMES and parts.netloc not in self._allowed:
                self._foreign.append(address)
        for entry in self.driver.get_log("browser"):
            no_webgl = "WebGL context" in entry["message"] and not self._webgl
            if entry["level"] == "SEVERE" and not no_webgl:
                self._errors.append(entry["message"])
