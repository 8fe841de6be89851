"""The paper's method: from observations to a twin, and from a twin to a prediction.

body        interface of a body; bodies/lattice, and the bodies of other packages, implement it
search      CMA-ES over topology and a homogeneous material: candidates (variables, twin, cost), trials (many candidates in one
            solver)
field       the neural spring field
fit         Adam through the simulation, on one or several recordings: parameters (trained tensors), batch (shared launches)
losses      all terms of the training loss, for search and fit
rollout     prediction
transfer    a twin on another recording with the same nodes
"""
