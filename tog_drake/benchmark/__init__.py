"""The benchmark: suites of trials, their episodes, and the tables of what came of them."""
