"""The models of the shipped scenes and the small kit that they are made with."""
