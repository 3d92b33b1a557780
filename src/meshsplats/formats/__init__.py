"""Files. Readers return physical values, writers take them; logits, logs and axis flips stay in here."""
