"""First-order training: the simulator flies, and gradients come from a surrogate of its control
step.

A gradient takes one batch of flights in which nothing is released. The simulator computes at every
step where a payload released there would land, so the outcome of every possible release of a flight
is known. A hazard makes the release smooth: ``h = sigmoid((a - threshold) / width)`` is the
probability that the latch trips in a step. The cost of a flight is the mean over the step of
release. With the survival S[k] = prod_(j < k) (1 - h[j]) it is

    - sum_k S[k] h[k] (reward at release k) - sum_k S[k - lag] (rewards while carrying) + S[end]
      (penalty of an end)

On a schedule the width falls, and the value of h becomes the latch's, 0 or 1, while its slope
remains the sigmoid's. The cost is then that of the actual flights, and the width is the kernel
width of an estimate of the number of releases that a change shifts. Soft barriers precede the
bounds, where rewards have no slope, and a slack rope, on which the vehicle has no influence.
Derivatives are propagated backward through surrogate and network and decay by a factor in each
step."""
