"""The command `connrsfm`: one file per sub-command, each of which loads what it needs when it runs."""
