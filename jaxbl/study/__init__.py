"""A study: config, points, engine, store, metrics, single runs."""
