"""GS-Dynamics: a graph network predicts where particles go when the hands move a centimetre further.

What it is. Particles drawn from tracks by farthest points, and tool nodes, form a graph; a network with three rounds of messages
gives each particle a displacement (`network`). It is trained per capture on windows of three past and five future steps
(`windows`, `objective`, `train`), a step being 1 cm of tool motion and no fixed time. In a rollout (`predict`) all structure points
follow particles that are drawn anew in each step (`propagate`), hold while the tools do, and move on straight lines between steps.

Written anew from a description of the public single-object code. How it was adapted to captures with hands was never published.
Choices of this platform, for lack of better knowledge:
- Tools: every controller is a tool node, with edges within the radius. Option: the mean of each hand, with edges to all particles.
  The motion of the tools is the largest of any. Tool positions are not smoothed.
- Tracks: path lengths are means over pairs of frames that see a point, times the number of pairs; smoothing uses what is seen.
- Windows: all of the training frames, no validation split; none where no step is ahead. Where too few tracks are seen throughout,
  those seen in the history take part, and errors are of what is seen.
- Edges are those of positions with noise; an action is the tool's next place minus the noisy one.
- An epoch is 100 updates on windows drawn with replacement; 50 epochs. Presets where the public values span a range: `rules`.
- A rollout starts at the structure points of frame 0, thrice; farthest points start at node 0. Transfers start at the target's
  points, not at the source's registered to it.
- Without any window, no motion is learned and none predicted; a failure only where the hands do move later.
- Up: the network sees a world with +z up; one with -z up is turned about x. So z is the coordinate along up.
Mistakes of the public code that are put right, each with a switch: the length loss of edges to tools (`faithful_length_loss`), and
means over particles that are not there (`padded_mean`, of positions). The limit on the number of edges is gone.

Limits of the method, kept: nothing moves while the hands are still, so nothing falls or swings; weights of all particles smear
motion (`propagation: nearest` does less); yaw is learned, not built in. Where part of an object rests, the part that the hands move
has unusual path lengths, and its tracks are dropped as outliers (`outlier_deviations: 0` keeps them).

Verified by tests: sizes of inputs and network; order of particles, shifts along the ground; edges, windows and losses by hand; what
a known network made is fitted back; rigid motions carry over exactly; hold, interpolation, divergence; a killed training continues
to the same weights on the CPU; nothing after the training frames is learned. Not verified: equality with the public code or with
published scores, as neither code nor its results were run.
"""
