"""The paper's method: from observations to a twin, and from a twin to a prediction.

body        what a twin is made of, asked by all others: bodies/lattice, and bodies of packages
search      CMA-ES over topology and a homogeneous material: candidates (variables, twin, cost), trials (many on the lanes of one
            solver)
field       the neural spring field
fit         Adam through the simulation, on one recording or several: parameters (what is trained), batch (fits that share launches)
losses      every term of the training loss, for search and fit
rollout     prediction
transfer    a twin on another recording with the same nodes
"""
