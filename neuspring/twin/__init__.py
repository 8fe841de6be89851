"""The paper's method: from observations to a twin, and from a twin to a prediction.

topology: points to regions, regions to springs. search: CMA-ES (proposals) over topology and a homogeneous material, with lengths
in units of spacing, then a polish on residuals; trace: its record; trials: its candidates, simulated and judged together. fit: Adam
through the simulation, on what parameters says is trained, by losses; field is the neural spring field; company: fits that share
launches. rollout: prediction. motion: velocities from observed points. transfer: a twin on another recording.

For others: topology.regions, piecewise_topology, uniform_topology; field.SpringField; parameters.TwinParameters;
losses.FrameLoss; search.SearchProblem, search; fit.FitProblem, fit, tail_start; company.together; rollout.roll_out;
transfer.rebase.
"""
