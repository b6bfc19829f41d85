"""Evaluation: metrics, the report page, and the ablation of the paper."""
