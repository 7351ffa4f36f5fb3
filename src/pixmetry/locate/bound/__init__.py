"""How well a target can be located: Fisher information, closed forms, predictions for each estimator."""
