"""What is needed to train and to judge the detector; not part of the installed package."""
