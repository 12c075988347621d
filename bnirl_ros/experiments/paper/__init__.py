"""The experiments of the paper's section 4 and its Table 1: `bnirl reproduce`.

`trials` has one run's demonstration, `courses` what each algorithm makes of it iteration by
iteration, `experiments` which of them run on what, and `runs` does that in processes. What comes
out goes to `figures`, `table1`, `sensitivity` and `claims`, and from there to the page of `page`;
`reproduce` leads through all of it. The scenarios themselves, with every choice that the paper
leaves open, are in `bnirl_ros/experiments/scenarios.py`.
"""
