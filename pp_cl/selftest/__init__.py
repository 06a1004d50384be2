"""The cases of `pp-cl selftest`, which compare every kernel with float64, also on hard inputs."""
