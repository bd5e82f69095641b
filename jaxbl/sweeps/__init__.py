"""From a study to its table: points, engine, store. Nothing is fitted or judged here."""
