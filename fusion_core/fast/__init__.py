"""Compiled ways of the filter, the same to rounding as `predict` and `correct` of `fusion_core.kalman`.

=============  =======================================  =====================  =======================================
way            when                                     factor                 price
=============  =======================================  =====================  =======================================
`plain`        asked for                                1                      nothing compiled
`loop`         anything varies, or a sample lacks a     200 (12 states in six  a compilation for each size of group,
               component or is refused                  groups)                kept for the next time
`groups`       always, under both that follow           10 (six groups of      the pattern of zeros is looked for once
                                                        two for one of 12)     a stretch
`steady`,      F, Q, H, R the same at every sample,     8 beyond `loop`        a compilation for each size and number
`lanes`        all measured                                                    of groups; data in the order of lanes
=============  =======================================  =====================  =======================================

`benchmarks/methods.py` measures the factors. `job` goes from one way to another within a call.
"""
