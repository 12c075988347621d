"""python -m bnirl_ros.cli"""

import sys

from bnirl_ros.cli import main

sys.exit(main())
