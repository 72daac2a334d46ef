"""Methods of other papers (Table 1 of Xi et al. 2024) for comparison with ours."""
