"""`python -m calib_ros` is `calib-ros`."""

import sys

from calib_ros.cli.main import main

sys.exit(main())
