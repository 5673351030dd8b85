"""One page a person can open to judge a reconstruction."""
