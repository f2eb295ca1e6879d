"""Learners: pictures in, actions out, trained on what `knotgym collect` writes. Needs torch."""
