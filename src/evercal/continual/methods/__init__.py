"""Methods for learning scenes one after another, one file a family."""
