"""The bundle: where its cores are, how much light they pass, and what each of them sees."""
