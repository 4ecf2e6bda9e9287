"""Step 1: the bundle, where its cores are and how much light they pass; step 3: what each core has sampled."""
