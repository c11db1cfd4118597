"""The live page on a port of its own, for tests: python live_server.py PORT NODE"""

from __future__ import annotations

import sys
from contextlib import suppress

from nicegui import app, ui

from calib_ros.ros.watch import Watch
from calib_ros.web.live_page import LivePage

if __name__ == "__main__":
    watch = Watch(sys.argv[2])
    LivePage(watch).register()
    app.on_shutdown(watch.close)
    with suppress(KeyboardInterrupt):  # uvicorn raises it once all is shut down
        ui.run(host="127.0.0.1", port=int(sys.argv[1]), reload=False, show=False, show_welcome_message=False)
