"""The roles of a run as Ray actors: plain classes, thin shells, typed clients, and the supervisor."""
