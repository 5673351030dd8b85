"""`python -m connrsfm_graph` is `connrsfm`."""

import sys

from connrsfm_graph.cli.main import main

sys.exit(main())
