"""The learner from pictures, trained on what `knotgym collect` writes. Needs torch."""
