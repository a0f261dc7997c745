"""`python -m cprl`: the command line where the script `cprl` is not on the path."""

import sys

from cprl.commands.main import main

if __name__ == "__main__":
    sys.argv[0] = "cprl"  # what recipes keep and messages repeat
    main()
