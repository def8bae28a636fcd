"""Allan and Hadamard deviations, and the noise coefficients that they show."""
