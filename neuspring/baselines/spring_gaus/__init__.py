"""Spring-Gaus: anchors with directed springs move splats; their parameters are trained on silhouettes.

What it is. Anchors drawn from the splats' centres each feel their 20 nearest others, the last four through a soft vector, and the
controllers nearby (`graph`, `kernels`, `reference`); the ground stops them. Splats follow 16 anchors by fixed weights. Training
replays the training frames from rest, compares the splats, white on black, with the object's mask in one random camera per frame,
sends the gradient through that frame alone, and makes a step of Adam (`train`, `objectives`, `silhouettes`). The rollout is
open-loop over all frames, with two outputs (`predict`): the splats' centres, absolute as in the original and so contracted a little
already in frame 0 (its record says how much), which pictures show; and the structure points in displacement form, exact in frame 0,
of which errors are taken. Chamfer distances of all centres are in the record too (`centres_chamfer_...`).

Written anew from a description of the public adaptation to PhysTwin's captures. What differs, and why:
- Intrinsics are each camera's own; the adaptation uses camera 0's focal lengths and moves the principal point to the middle.
- Splats begin on the shape prior, as the PhysTwin paper reports; the public adaptation begins grey in an alpha shape
  (`spring_gaus_alpha`: 10,000 points, none rejected). Colour is the constant harmonic, not a sigmoid. As many steps as the
  platform's splats, not 30,000, on the schedules of 30,000; hands, dilated, are not compared; SSIM is taken around the object.
- Negative damping is clamped at zero (`negative_damping` allows it); rest lengths of links are at least 0.1 mm.
- A frame that leaves the scene (10 m), or whose loss or gradient is not finite, counts as failed like NaN does. What still fails
  with the most substeps ends training as a failure with a reason; the parameters of the last complete iteration are rolled out, and
  held at the last finite frame for the average over all runs.
- Without VGG16's weights, which are never downloaded, its term of the loss is left out, and the run's notes say so.
- Where the mask is empty there is no distance of centroids.
- The initial velocity is added on entering a frame and removed on leaving it, as in the public code.
Kept although it harms: directed springs, which conserve no momentum; friction per substep, so more substeps stick more; the object
counts as absent behind hands (`ignore_hands` leaves them out); forces at 1 kg per anchor, which no other convention shares.

Variants: `supervision: points` (row `spring_gaus_points`), for captures without images: anchors drawn from the structure points,
the Chamfer and track losses of the other methods, the platform's splats. `spring_gaus_shared_splats`: the platform's splats, masks.

Verified by tests: the soft vector's published values, rest without force, drop and rest on the ground, kernel and gradient against
a float64 reference, what the model made itself is fitted back, escalation of substeps, failures, a killed training continues to the
same model on the CPU. Not verified: equality with the public code or with published scores, as neither was run.
"""
