"""Which effects of light a scene calls for, by proof: statistics of the heights, bounds that follow from them, verdicts.

``statistics.measure_heights`` measures in one pass, ``plan.plan_effects`` decides, ``text.plan_rows`` puts it into words.
docs/EFFECTS.md has the derivations.
"""
