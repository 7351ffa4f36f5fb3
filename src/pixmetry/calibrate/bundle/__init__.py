"""The bundle adjustment: model, network, normal equations, covariance, datum."""
