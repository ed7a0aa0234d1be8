"""What users rely on: ``import quadjax``, commands, files and exported C. No inner modules."""
