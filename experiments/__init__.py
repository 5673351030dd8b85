"""One script for each table or figure; each is run as a module, for example `python -m experiments.theorem`."""
