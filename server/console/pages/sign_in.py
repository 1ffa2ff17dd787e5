"""Implements the page that asks for an API key. The API key is sent over the page's socket, never in an address."""

import asyncio

import anyio.to_thread
from nicegui import app as pages
from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from rig.messages.message import compose
from server.console.identity import KEY_ID, service_of_pages
from server.console.page import signed_in

WRONG_PAUSE_S = 1.0  # after a key that is nobody's


class SignIn(Element, component="sign_in.js"):
    """Shows the form for an API key. The id of a valid API key is stored in the browser's session, and the page of the
    rig opens. After a wrong key the form waits a second, which slows guessing."""

    def __init__(self) -> None:
        super().__init__()
        self.on("key", self._try)

    async def _try(self, event: GenericEventArguments) -> None:
        caller = await anyio.to_thread.run_sync(service_of_pages().keys.caller, str(event.args)[:200].strip())
        if caller is None:
            await asyncio.sleep(WRONG_PAUSE_S)
            self.run_method("refuse", compose("no-such-key").document())
        else:
            pages.storage.user[KEY_ID] = caller.key
            ui.navigate.to("/")


@ui.page("/sign-in")
async def sign_in_page() -> None:
    """Serves the page that asks for an API key, or redirects to the page Rig if no API key is needed."""
    ui.page_title("Sign in - eigenhead")
    caller = await signed_in()
    if caller is not None and caller.key == "local":
        ui.navigate.to("/")
    SignIn()
