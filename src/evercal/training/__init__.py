"""Fitting a head to rows of features: views, buffer, reprojection loss and the loop."""
