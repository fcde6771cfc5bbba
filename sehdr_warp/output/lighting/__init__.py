"""The light of a scene for other programs: environment maps, lights, and the unit of radiance in cd/m^2."""
